"""``traffic=sumo``: the others are driven by SUMO, some of them lorries; the ego is ours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.parameters.driving import IdmParameters, Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.parameters.traffic import SumoParameters
from ganlane.sim.dynamics import STEERING, SteeringParameters, ego_scene, move_ego
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.scenes import Scenes
from ganlane.sim.spawn import TABLE_II, RandomScenes
from ganlane.sim.state import Road, Vehicles, body_lanes, presence, with_target
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.foreign.sumo_roads import Array, Place, SumoDriver, SumoRoads, require_libsumo

#: Vehicles of this length (m) and more are driven as lorries.
LORRY_M = 7.0
#: Lateral motion above this, m per step, is a lane change; SUMO's slowest one has ten times as much.
_SIDEWAYS_M = 1e-3
#: Bound of the heading, rad: SUMO moves a vehicle sideways even where it hardly drives.
_STEEPEST_RAD = 0.2
#: Physics steps between two changes of a driver's desired speed.
_PACE_STEPS = 10
#: Columns of :attr:`ganlane.sim.random.Purpose.FOREIGN_DRIVER`: the first two of the initial scene, then a driver's.
_IS_LORRY, _DESIRED, _TAU, _ACCEL, _DECEL, _MIN_GAP, _PACE_PERIOD, _PACE_PHASE = range(8)


@dataclass(frozen=True)
class LorryScenes:
    """:class:`ganlane.sim.spawn.RandomScenes` with lorries among the others, at the same net gaps.

    A lorry takes more of its lane, so whoever drives ahead of it there starts so much further ahead: nobody has to
    brake harder than in the scene of cars.

    Attributes:
        cars: the scenes to start from.
        share: of the others, 0 to 1; each is a lorry or not by itself.
        length_m: of a lorry; its width is that of a car.
        desired_speed_mps: (low, high) of a lorry's desired speed; 80 to 90 km/h.
    """

    cars: RandomScenes
    share: float = 0.15
    length_m: float = 12.0
    desired_speed_mps: tuple[float, float] = (22.0, 25.0)

    @property
    def vehicles(self) -> int:
        """M, the ego included."""
        return self.cars.vehicles

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle that there may be, m."""
        return max(self.cars.longest_m, self.length_m) if self.share > 0 else self.cars.longest_m

    def check(self, road: Road, idm: IdmParameters) -> None:
        """As :meth:`RandomScenes.check`."""
        self.cars.check(road, idm)

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """Vehicles [N, M] at the start of the episodes with ``key`` [N]; the ego at index 0 and x = 0."""
        scene = self.cars(key, dtype)
        u = uniform(key, 0, self.vehicles, [Purpose.FOREIGN_DRIVER + _IS_LORRY, Purpose.FOREIGN_DRIVER + _DESIRED])
        is_lorry = (u[..., 0] < self.share) & (torch.arange(self.vehicles, device=key.device) != EGO_INDEX)
        length = torch.where(is_lorry, max(self.length_m, self.cars.parameters.length_m), scene.length)
        low, high = self.desired_speed_mps
        desired = torch.where(is_lorry, (low + u[..., 1] * (high - low)).to(dtype), scene.desired_speed)
        x = scene.x + _room_taken(scene, length - scene.length)
        return scene.with_(x=x - x[:, EGO_INDEX, None], length=length, desired_speed=desired)


def _room_taken(scene: Vehicles, extra: Tensor) -> Tensor:
    """How far forward each centre moves, m, [N, M], where bodies are longer by ``extra`` and net gaps stay."""
    same = scene.target_lane[:, :, None] == scene.target_lane[:, None, :]
    behind = scene.x[:, None, :] < scene.x[:, :, None]
    return (extra[:, None, :] * (same & behind)).sum(-1) + 0.5 * extra


@dataclass(frozen=True)
class DriverRanges:
    """Ranges (low, high) of the drivers' parameters: s, m/s2, m. SUMO's defaults lie within."""

    tau: tuple[float, float] = (0.9, 1.6)
    accel: tuple[float, float] = (1.5, 3.0)
    decel: tuple[float, float] = (3.5, 5.0)
    min_gap: tuple[float, float] = (1.5, 3.0)
    emergency_decel: float = 9.0


CARS = DriverRanges()
LORRIES = DriverRanges(tau=(1.2, 2.0), accel=(0.8, 1.3), decel=(3.0, 4.5), min_gap=(2.0, 3.5), emergency_decel=7.0)


class SumoTraffic(TrafficModule):
    """The others driven by SUMO: Krauss along the road, LC2013 across it, some of them lorries.

    The ego moves as in every traffic. In SUMO a stand-in drives in its place, in every lane in which the others see
    the ego, and arrives at the end of a step where the ego does, so they follow and give way to it as to any vehicle.
    Drivers differ (:data:`CARS`, :data:`LORRIES`), and the desired speed of each wanders around its own; all numbers
    follow from (stream, seed, episode). SUMO's own dawdling (``sigma``) is off: it draws from a generator that all
    vehicles share, so an episode would depend on the batch.

    SUMO's state is not in the TensorDict, and a process has one simulation. So an episode can only continue where it
    was left. It cannot be branched, and two modules cannot take turns; both are refused.

    Args:
        road, stream, idm, steering: as for every traffic module; idm and steering are the ego's.
        spawn: Table II, for the first scenes.
        truck_share: of the others, 0 to 1, where ``spawn`` has none.
        truck_length_m: length of a lorry.
        lane_change_s: duration of a lane change.
        keep_right: LC2013's ``lcKeepRight``.
        speed_wander: amplitude of a desired speed's variation, as a share of it; the periods are 20 to 60 s.

    Raises:
        UserError: libsumo is not installed, or the road is a ring.
    """

    visibility = Visibility.SIGNALLED
    #: Each row has a highway of its own in SUMO.
    rows_must_stay = True
    memory_fields = {"steering": ((), None)}  # noqa: RUF012

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        idm: IdmParameters = TABLE_V,
        steering: SteeringParameters = STEERING,
        spawn: SpawnParameters = TABLE_II,
        truck_share: float = SumoParameters.truck_share,
        truck_length_m: float = SumoParameters.truck_length_m,
        lane_change_s: float = SumoParameters.lane_change_s,
        keep_right: float = SumoParameters.keep_right,
        speed_wander: float = SumoParameters.speed_wander,
    ) -> None:
        super().__init__(road, stream)
        require_libsumo()
        if self.road.ring_m is not None:
            raise UserError(f"traffic sumo: a ring of {self.road.ring_m:g} m; SUMO's roads here are straight.")
        self.idm, self.steering, self.spawn = idm, steering, spawn
        self.truck_share, self.truck_length_m = truck_share, truck_length_m
        self.lane_change_s, self.keep_right, self.speed_wander = lane_change_s, keep_right, speed_wander
        self._roads: SumoRoads | None = None
        self._episodes: _Episodes | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without the simulation: a copy, or another process, starts its own."""
        return {**self.__dict__, "_roads": None, "_episodes": None}

    def compile_graphs(self) -> None:
        """Nothing can be compiled."""

    def scenes(
        self, vehicles: int, ego_visibility: int = Visibility.BODY, ego_desired_speed_mps: float = 25.0
    ) -> Scenes:
        """Table II with lorries: so many as the environment says (``env.truck_share``), or else ``truck_share``."""
        cars = RandomScenes(self.road, vehicles, self.spawn, ego_visibility, self.visibility)
        if self.spawn.truck_share > 0:
            return cars
        return LorryScenes(cars, self.truck_share, self.truck_length_m)

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Wheels straight; only the ego's are used."""
        return {"steering": torch.zeros_like(vehicles.x)}

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """One step of SUMO; rows at step 0 are set up anew first."""
        fresh = (step == 0).cpu().numpy()
        roads, episodes = self._simulation(vehicles, fresh)
        seen = _Seen.of(vehicles)
        driving = self._check(episodes, seen, fresh, key.cpu().numpy())
        for row in np.flatnonzero(fresh):
            self._start(roads, episodes, int(row), seen, key)
        ego, steering = self._ego_next(vehicles, memory["steering"])
        self._lead_egos(roads, driving, vehicles, ego, seen)
        self._wander(roads, episodes, driving, step.cpu().numpy())
        roads.step()
        moved = self._moved(roads, driving, vehicles, seen)
        episodes.inputs, episodes.outputs = seen, _Seen.of(moved)
        return moved, {"steering": torch.cat((steering[:, None], memory["steering"][:, 1:]), dim=1)}

    def _simulation(self, vehicles: Vehicles, fresh: NDArray[np.bool_]) -> tuple[SumoRoads, _Episodes]:
        """The running simulation, or a new one if all episodes begin."""
        n, m = vehicles.x.shape
        roads, episodes = self._roads, self._episodes
        if roads is not None and episodes is not None and roads.is_open and episodes.shape == (n, m):
            return roads, episodes
        if not fresh.all():
            raise UserError(
                "traffic sumo: the simulation of this episode is gone, since a process has one SUMO and "
                "somebody else has used it meanwhile; finish one environment before the next one starts."
            )
        assert isinstance(self.road.lanes, int)
        width = float(self.road.lane_width_m)
        roads = self._roads = SumoRoads(n, self.road.lanes, width, self.lane_change_s, self.keep_right)
        episodes = self._episodes = _Episodes(n, m)
        return roads, episodes

    def _check(
        self, episodes: _Episodes, seen: _Seen, fresh: NDArray[np.bool_], key: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Which rows drive in this step. A row that has ended comes again as it was, and is taken off the road.

        Raises:
            UserError: the state of a row is neither the one that SUMO left nor one that has ended.
        """
        assert self._roads is not None
        follows = fresh | (seen.same(episodes.outputs) & ~episodes.ended & (key == episodes.keys))
        waits = ~follows & seen.same(episodes.inputs) & (key == episodes.keys)
        shifted = ~follows & ~waits & ~episodes.ended & seen.shifted(episodes.outputs) & (key == episodes.keys)
        for row in np.flatnonzero(waits & ~episodes.ended):
            self._roads.clear(int(row))
        for row in np.flatnonzero(shifted):
            self._shift(int(row), seen, episodes.outputs)
        if not (follows | waits | shifted).all():
            raise UserError(
                "traffic sumo: this state is not the one that SUMO left (it was loaded, copied or changed), and "
                "SUMO can only drive on from where it is; start the episode again."
            )
        episodes.ended = waits
        return follows | shifted

    def _shift(self, row: int, seen: _Seen, left: _Seen | None) -> None:
        """Follow ``env.recycle``: some of the others are elsewhere along the road."""
        assert self._roads is not None
        assert left is not None
        for i in np.flatnonzero(seen.x[row, 1:] != left.x[row, 1:]) + 1:
            self._roads.replace(row, int(i) - 1, self._place(seen, row, int(i)))

    def _place(self, seen: _Seen, row: int, i: int) -> Place:
        lane = round(float(seen.y[row, i]) / float(self.road.lane_width_m))
        return Place(min(max(lane, 0), int(self.road.lanes) - 1), float(seen.x[row, i]), float(seen.speed[row, i]))

    def _start(self, roads: SumoRoads, episodes: _Episodes, row: int, seen: _Seen, key: Tensor) -> None:
        """A new episode on a highway."""
        m = seen.x.shape[1]
        roads.clear(row)
        purposes = list(range(Purpose.FOREIGN_DRIVER, Purpose.FOREIGN_DRIVER + _PACE_PHASE + 1))
        u = uniform(key[row : row + 1].cpu(), 0, m, purposes, torch.float64)[0].numpy()
        drivers = [_driver(u[i], seen, row, i) if seen.valid[row, i] else None for i in range(1, m)]
        roads.fill(row, drivers, [self._place(seen, row, i) for i in range(1, m)])
        episodes.keys[row] = int(key[row])
        episodes.ended[row] = False
        episodes.desired_speed[row] = seen.desired_speed[row]
        episodes.pace_turns[row] = 0.1 / (20.0 + 40.0 * u[:, _PACE_PERIOD])
        episodes.pace_phase[row] = u[:, _PACE_PHASE]

    def _ego_next(self, vehicles: Vehicles, steering: Tensor) -> tuple[Vehicles, Tensor]:
        """Where the ego will be at t + 0.1 s, fields [N], and its steering angle [N]: as the environment moves it."""
        acceleration = following_acceleration(ego_scene(vehicles, self.road), self.idm)[:, 0]
        return move_ego(vehicles, acceleration, steering[:, 0], self.road, self.steering, self.dt)

    def _lead_egos(
        self, roads: SumoRoads, driving: NDArray[np.bool_], vehicles: Vehicles, ego: Vehicles, seen: _Seen
    ) -> None:
        """The stand-ins on their way to where the egos will be."""
        one = Vehicles(*(field[:, None] for field in ego))
        body = body_lanes(one, self.road)
        lanes = presence(one, self.road, body, with_target(body, one))
        low, high, x = (field[:, 0].tolist() for field in (lanes.low, lanes.high, one.x))
        for row in np.flatnonzero(driving):
            driver = _stand_in(seen, int(row))
            here = Place(0, float(seen.x[row, EGO_INDEX]), float(seen.speed[row, EGO_INDEX]))
            there = range(int(low[row]), int(high[row]) + 1) if seen.valid[row, EGO_INDEX] else range(0)
            roads.lead_ego(int(row), there, driver, here, x[row])

    def _wander(
        self, roads: SumoRoads, episodes: _Episodes, driving: NDArray[np.bool_], step: NDArray[np.int64]
    ) -> None:
        """Once a second the drivers of a row change their desired speeds: a sine of each driver's own."""
        if self.speed_wander == 0.0:
            return
        for row in np.flatnonzero(driving & (step % _PACE_STEPS == 0)):
            turns = step[row] * episodes.pace_turns[row] + episodes.pace_phase[row]
            speeds = episodes.desired_speed[row] * (1.0 + self.speed_wander * np.sin(2.0 * np.pi * turns))
            for name, speed in zip(roads.names[row], speeds[1:].tolist()):
                if name:
                    roads.set_desired_speed(name, speed)

    def _moved(self, roads: SumoRoads, driving: NDArray[np.bool_], vehicles: Vehicles, seen: _Seen) -> Vehicles:
        """SUMO's state as our fields; rows that do not drive stay as they are."""
        rows, index, front, speeds = roads.read()
        index = index + 1
        x, y, speed, heading, acceleration = (
            field.astype(np.float64) for field in (seen.x, seen.y, seen.speed, seen.heading, 0.0 * seen.x)
        )
        target, valid = seen.target_lane.copy(), seen.valid.copy()
        new_x = front[:, 0] - 0.5 * seen.length[rows, index]
        dx, dy = new_x - x[rows, index], front[:, 1] - y[rows, index]
        heading[rows, index] = np.clip(np.arctan2(dy, np.maximum(dx, 1e-6)), -_STEEPEST_RAD, _STEEPEST_RAD)
        acceleration[rows, index] = (speeds - speed[rows, index]) / self.dt
        x[rows, index], y[rows, index], speed[rows, index] = new_x, front[:, 1], speeds
        target[rows, index] = self._targets(front[:, 1], dy)
        valid[:, 1:] &= ~driving[:, None]
        valid[rows, index] = True
        made = {"x": x, "y": y, "speed": speed, "heading": heading, "acceleration": acceleration}
        like = vehicles.x
        floats = {name: torch.as_tensor(value).to(like.device, like.dtype) for name, value in made.items()}
        moved = vehicles.with_(
            **floats,
            target_lane=torch.as_tensor(target).to(like.device),
            valid=torch.as_tensor(valid).to(like.device),
        )
        return moved.where(torch.as_tensor(driving).to(like.device), vehicles).with_first(vehicles.at(EGO_INDEX))

    def _targets(self, y: Array, dy: Array) -> NDArray[np.int64]:
        """The lane that each vehicle keeps, or is moving to: the next centre in the direction that it moves."""
        lane, close = y / float(self.road.lane_width_m), 1e-3
        left, right = np.ceil(lane - close), np.floor(lane + close)
        target = np.where(dy > _SIDEWAYS_M, left, np.where(dy < -_SIDEWAYS_M, right, np.round(lane)))
        return np.clip(target, 0, int(self.road.lanes) - 1).astype(np.int64)


class _Seen:
    """The used fields of vehicles as arrays [N, M] on the CPU."""

    def __init__(self, vehicles: Vehicles) -> None:
        def array(field: Tensor) -> Any:
            return field.detach().cpu().numpy()

        self.x, self.y, self.speed, self.heading = map(
            array, (vehicles.x, vehicles.y, vehicles.speed, vehicles.heading)
        )
        self.length, self.width = array(vehicles.length), array(vehicles.width)
        self.desired_speed = array(vehicles.desired_speed)
        self.target_lane, self.valid = array(vehicles.target_lane), array(vehicles.valid)

    @classmethod
    def of(cls, vehicles: Vehicles) -> _Seen:
        """From tensors, which must not be written to afterwards."""
        return cls(vehicles)

    def same(self, other: _Seen | None) -> NDArray[np.bool_]:
        """Rows [N] in which the others are where they are in ``other``."""
        if other is None:
            return np.zeros(len(self.x), dtype=bool)
        return self.shifted(other) & (self.x[:, 1:] == other.x[:, 1:]).all(1)

    def shifted(self, other: _Seen | None) -> NDArray[np.bool_]:
        """Rows [N] in which the others are as in ``other``, but perhaps somewhere else along the road."""
        if other is None:
            return np.zeros(len(self.x), dtype=bool)
        alike = (self.y == other.y) & (self.speed == other.speed) & (self.valid == other.valid)
        return alike[:, 1:].all(1)


class _Episodes:
    """State of the rows outside SUMO; [N] or [N, M]."""

    def __init__(self, n: int, m: int) -> None:
        self.shape = (n, m)
        self.keys = np.zeros(n, dtype=np.int64)
        self.ended = np.zeros(n, dtype=bool)
        self.inputs: _Seen | None = None
        self.outputs: _Seen | None = None
        self.desired_speed = np.ones((n, m))
        self.pace_turns = np.zeros((n, m))
        self.pace_phase = np.zeros((n, m))


def _driver(u: Array, seen: _Seen, row: int, i: int) -> SumoDriver:
    """A driver by the uniforms ``u`` in [0, 1)."""
    ranges = LORRIES if seen.length[row, i] >= LORRY_M else CARS

    def drawn(bounds: tuple[float, float], column: int) -> float:
        return bounds[0] + float(u[column]) * (bounds[1] - bounds[0])

    return SumoDriver(
        desired_speed=float(seen.desired_speed[row, i]),
        length=float(seen.length[row, i]),
        width=float(seen.width[row, i]),
        tau=drawn(ranges.tau, _TAU),
        accel=drawn(ranges.accel, _ACCEL),
        decel=drawn(ranges.decel, _DECEL),
        emergency_decel=ranges.emergency_decel,
        min_gap=drawn(ranges.min_gap, _MIN_GAP),
    )


def _stand_in(seen: _Seen, row: int) -> SumoDriver:
    """The ego's stand-in: an ordinary car for SUMO's drivers."""
    length, width = float(seen.length[row, EGO_INDEX]), float(seen.width[row, EGO_INDEX])
    return SumoDriver(float(seen.desired_speed[row, EGO_INDEX]), length, width, 1.0, 2.6, 4.5, 9.0, 2.5)
