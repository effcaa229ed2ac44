"""``traffic=sumo``: the others are driven by SUMO, some of them lorries; the ego is ours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.settings.traffic import SumoTrafficConfig
from ganlane.settings.episode import SpawnParameters
from ganlane.sim.dynamics import STEERING, SteeringParameters, ego_scene, move_ego
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.scenes import Scenes
from ganlane.sim.spawn import TABLE_II, RandomScenes
from ganlane.sim.state import Road, Vehicles, body_lanes, presence, with_target
from ganlane.traffic.base import Memory, Moved, TrafficModule, require
from ganlane.traffic.sumo_roads import LIBSUMO, Array, Place, SumoDriver, SumoRoads

#: Vehicles of this length (m) and more are driven as lorries.
LORRY_M = 7.0
#: Lateral motion above this, m per step, is a lane change; SUMO's slowest one has ten times as
#: much.
_SIDEWAYS_M = 1e-3
#: Bound of the heading, rad: SUMO moves a vehicle sideways even where it hardly drives.
_STEEPEST_RAD = 0.2
#: Physics steps between two changes of a driver's desired speed.
_PACE_STEPS = 10
#: Columns of :attr:`ganlane.sim.random.Purpose.FOREIGN_DRIVER`: the first two of the initial scene,
#: then a driver's.
_IS_LORRY, _DESIRED, _TAU, _PACE_PERIOD, _PACE_PHASE = 0, 1, 2, 6, 7


@dataclass(frozen=True)
class LorryScenes:
    """``cars`` with lorries among the others, at the same net gaps.

    A lorry takes more of its lane, so whoever drives ahead of it there starts so much further
    ahead: nobody has to brake harder than in the scene of cars. Each of the others is a lorry with
    probability ``share``, of a car's width and with a desired speed of 22 to 25 m/s, 80 to 90 km/h.
    """

    cars: RandomScenes
    share: float = 0.15
    length_m: float = 12.0

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
        """Vehicles [N, M] at the start of the episodes with ``key`` [N].

        The ego at index 0 and x = 0.
        """
        scene = self.cars(key, dtype)
        u = uniform(
            key,
            0,
            self.vehicles,
            [Purpose.FOREIGN_DRIVER + _IS_LORRY, Purpose.FOREIGN_DRIVER + _DESIRED],
        )
        is_lorry = (u[..., 0] < self.share) & (
            torch.arange(self.vehicles, device=key.device) != EGO_INDEX
        )
        length = torch.where(
            is_lorry, max(self.length_m, self.cars.parameters.length_m), scene.length
        )
        desired = torch.where(
            is_lorry, (22.0 + u[..., 1] * (25.0 - 22.0)).to(dtype), scene.desired_speed
        )
        # Each centre moves forward by what those behind it in its lane and its own rear half are
        # longer.
        extra = length - scene.length
        same = scene.target_lane[:, :, None] == scene.target_lane[:, None, :]
        behind = scene.x[:, None, :] < scene.x[:, :, None]
        x = scene.x + ((extra[:, None, :] * (same & behind)).sum(-1) + 0.5 * extra)
        return scene.with_(x=x - x[:, EGO_INDEX, None], length=length, desired_speed=desired)


#: Ranges (low, high) of the drivers' parameters, s, m/s2, m, in the order of their columns; SUMO's
#: own lie within.
CARS = {"tau": (0.9, 1.6), "accel": (1.5, 3.0), "decel": (3.5, 5.0), "min_gap": (1.5, 3.0)}
LORRIES = {"tau": (1.2, 2.0), "accel": (0.8, 1.3), "decel": (3.0, 4.5), "min_gap": (2.0, 3.5)}


class SumoTraffic(TrafficModule):
    """The others driven by SUMO: Krauss along the road, LC2013 across it, some of them lorries.

    The ego moves as in every traffic. In SUMO a stand-in drives in its place, in every lane in
    which the others see the ego, and arrives at the end of a step where the ego does, so they
    follow and give way to it as to any vehicle. Drivers differ (:data:`CARS`, :data:`LORRIES`), and
    the desired speed of each wanders around its own; all numbers follow from (stream, seed,
    episode). SUMO's own dawdling (``sigma``) is off: it draws from a generator that all vehicles
    share, so an episode would depend on the batch.

    SUMO's state is not in the TensorDict, and a process has one simulation. So an episode can only
    continue where it was left. It cannot be branched, and two modules cannot take turns; both are
    refused.

    Args:
        road, stream, idm, steering: as for every traffic module; idm and steering are the ego's.
        spawn: Table II, for the first scenes.
        truck_share, truck_length_m, lane_change_s, keep_right: see
            :class:`~ganlane.settings.traffic.SumoTrafficConfig`.
        speed_wander: amplitude of a desired speed's variation, as a share of it; the periods are 20
            to 60 s.

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
        truck_share: float = SumoTrafficConfig.truck_share,
        truck_length_m: float = SumoTrafficConfig.truck_length_m,
        lane_change_s: float = SumoTrafficConfig.lane_change_s,
        keep_right: float = SumoTrafficConfig.keep_right,
        speed_wander: float = SumoTrafficConfig.speed_wander,
    ) -> None:
        super().__init__(road, stream)
        require(*LIBSUMO)
        if self.road.ring_m is not None:
            raise UserError(
                f"traffic sumo: a ring of {self.road.ring_m:g} m; SUMO's roads here are straight."
            )
        self.idm, self.steering, self.spawn = idm, steering, spawn
        self.truck_share, self.truck_length_m = truck_share, truck_length_m
        self.lane_change_s, self.keep_right, self.speed_wander = (
            lane_change_s,
            keep_right,
            speed_wander,
        )
        self._simulation: _Simulation | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without the simulation: a copy, or another process, starts its own."""
        return {**self.__dict__, "_simulation": None}

    def compile_graphs(self) -> None:
        """Nothing can be compiled."""

    def scenes(
        self,
        vehicles: int,
        ego_visibility: int = Visibility.BODY,
        ego_desired_speed_mps: float = 25.0,
    ) -> Scenes:
        """Table II with lorries.

        So many as the environment says (``env.truck_share``), or else ``truck_share``.
        """
        cars = RandomScenes(self.road, vehicles, self.spawn, ego_visibility, self.visibility)
        if self.spawn.truck_share > 0:
            return cars
        return LorryScenes(cars, self.truck_share, self.truck_length_m)

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """One step of SUMO; rows at step 0 are set up anew first. Only the ego's steering is used."""
        fresh, seen = (step == 0).cpu().numpy(), _arrays(vehicles)
        now = self._running(seen, fresh)
        driving = self._check(now, seen, fresh, key.cpu().numpy())
        for row in np.flatnonzero(fresh):
            self._start(now, int(row), seen, key)
        # Where the egos will be at t + 0.1 s, as the environment moves them.
        acceleration = following_acceleration(ego_scene(vehicles, self.road), self.idm)[:, 0]
        steering = memory["steering"]
        ego, wheels = move_ego(
            vehicles, acceleration, steering[:, 0], self.road, self.steering, self.dt
        )
        self._lead_egos(now.roads, driving, ego, seen)
        self._wander(now, driving, step.cpu().numpy())
        now.roads.step()
        moved = self._moved(now.roads, driving, vehicles, seen)
        now.inputs, now.outputs = seen, _arrays(moved)
        return moved, {"steering": torch.cat((wheels[:, None], steering[:, 1:]), dim=1)}

    def _running(self, seen: Any, fresh: NDArray[np.bool_]) -> _Simulation:
        """The running simulation, or a new one if all episodes begin."""
        now, (n, m) = self._simulation, seen.x.shape
        if now is not None and now.roads.is_open and now.desired_speed.shape == (n, m):
            return now
        if not fresh.all():
            raise UserError(
                "traffic sumo: the simulation of this episode is gone, since a process has one SUMO and "
                "somebody else has used it meanwhile; finish one environment before the next one starts."
            )
        assert isinstance(self.road.lanes, int)
        width = float(self.road.lane_width_m)
        roads = SumoRoads(n, self.road.lanes, width, self.lane_change_s, self.keep_right)
        self._simulation = _Simulation(roads, n, m)
        return self._simulation

    def _check(
        self, now: _Simulation, seen: Any, fresh: NDArray[np.bool_], key: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Which rows drive in this step. A row that has ended comes again as it was, and is taken
        off the road.

        With ``env.recycle`` some of the others may be elsewhere along the road.

        Raises:
            UserError: the state of a row is neither the one that SUMO left nor one that has ended.
        """
        known = key == now.keys
        left = known & ~now.ended & _same(seen, now.outputs, ("y", "speed", "valid"))
        follows = fresh | (left & _same(seen, now.outputs, ("x",)))
        waits = ~follows & known & _same(seen, now.inputs, ("x", "y", "speed", "valid"))
        shifted = ~follows & ~waits & left
        for row in np.flatnonzero(waits & ~now.ended):
            now.roads.clear(int(row))
        if shifted.any():
            for row, index in np.argwhere(shifted[:, None] & (seen.x != now.outputs.x)[:, 1:]):
                now.roads.replace(int(row), int(index), self._place(seen, row, index + 1))
        if not (follows | waits | shifted).all():
            raise UserError(
                "traffic sumo: this state is not the one that SUMO left (it was loaded, copied or changed), and "
                "SUMO can only drive on from where it is; start the episode again."
            )
        now.ended = waits
        return follows | shifted

    def _place(self, seen: Any, row: int, i: int) -> Place:
        lane = round(float(seen.y[row, i]) / float(self.road.lane_width_m))
        return Place(
            min(max(lane, 0), int(self.road.lanes) - 1),
            float(seen.x[row, i]),
            float(seen.speed[row, i]),
        )

    def _start(self, now: _Simulation, row: int, seen: Any, key: Tensor) -> None:
        """A new episode on a highway."""
        m = seen.x.shape[1]
        now.roads.clear(row)
        purposes = list(range(Purpose.FOREIGN_DRIVER, Purpose.FOREIGN_DRIVER + _PACE_PHASE + 1))
        u = uniform(key[row : row + 1].cpu(), 0, m, purposes, torch.float64)[0].numpy()
        drivers = [_driver(u[i], seen, row, i) if seen.valid[row, i] else None for i in range(1, m)]
        now.roads.fill(row, drivers, [self._place(seen, row, i) for i in range(1, m)])
        now.keys[row], now.ended[row] = int(key[row]), False
        now.desired_speed[row] = seen.desired_speed[row]
        now.pace_turns[row], now.pace_phase[row] = (
            0.1 / (20.0 + 40.0 * u[:, _PACE_PERIOD]),
            u[:, _PACE_PHASE],
        )

    def _lead_egos(
        self, roads: SumoRoads, driving: NDArray[np.bool_], ego: Vehicles, seen: Any
    ) -> None:
        """The stand-ins, ordinary cars for SUMO's drivers, on their way to where the egos will be."""
        one = Vehicles(*(field[:, None] for field in ego))
        body = body_lanes(one, self.road)
        lanes = presence(one, self.road, body, with_target(body, one))
        low, high, x = (field[:, 0].tolist() for field in (lanes.low, lanes.high, one.x))
        now = seen.at(EGO_INDEX)
        for row in np.flatnonzero(driving):
            desired, length, width = (
                float(field[row]) for field in (now.desired_speed, now.length, now.width)
            )
            driver = SumoDriver(desired, length, width, 1.0, 2.6, 4.5, 9.0, 2.5)
            here = Place(0, float(now.x[row]), float(now.speed[row]))
            there = range(int(low[row]), int(high[row]) + 1) if now.valid[row] else range(0)
            roads.lead_ego(int(row), there, driver, here, x[row])

    def _wander(
        self, now: _Simulation, driving: NDArray[np.bool_], step: NDArray[np.int64]
    ) -> None:
        """Once a second the drivers of a row change their desired speeds.

        A sine of each driver's own.
        """
        if self.speed_wander == 0.0:
            return
        for row in np.flatnonzero(driving & (step % _PACE_STEPS == 0)):
            turns = step[row] * now.pace_turns[row] + now.pace_phase[row]
            speeds = now.desired_speed[row] * (
                1.0 + self.speed_wander * np.sin(2.0 * np.pi * turns)
            )
            for name, speed in zip(now.roads.names[row], speeds[1:].tolist()):
                if name:
                    now.roads.set_desired_speed(name, speed)

    def _moved(
        self, roads: SumoRoads, driving: NDArray[np.bool_], vehicles: Vehicles, seen: Any
    ) -> Vehicles:
        """SUMO's state as our fields; rows that do not drive stay as they are."""
        rows, index, front, speeds = roads.read()
        index = index + 1
        x, y, speed, heading, acceleration = (
            field.astype(np.float64)
            for field in (seen.x, seen.y, seen.speed, seen.heading, 0.0 * seen.x)
        )
        target, valid = seen.target_lane.copy(), seen.valid.copy()
        new_x = front[:, 0] - 0.5 * seen.length[rows, index]
        dx, dy = new_x - x[rows, index], front[:, 1] - y[rows, index]
        heading[rows, index] = np.clip(
            np.arctan2(dy, np.maximum(dx, 1e-6)), -_STEEPEST_RAD, _STEEPEST_RAD
        )
        acceleration[rows, index] = (speeds - speed[rows, index]) / self.dt
        x[rows, index], y[rows, index], speed[rows, index] = new_x, front[:, 1], speeds
        # The lane that a vehicle keeps, or is moving to: the next centre in the direction in which
        # it moves.
        lane, close = front[:, 1] / float(self.road.lane_width_m), 1e-3
        left, right = np.ceil(lane - close), np.floor(lane + close)
        lane = np.where(dy > _SIDEWAYS_M, left, np.where(dy < -_SIDEWAYS_M, right, np.round(lane)))
        target[rows, index] = np.clip(lane, 0, int(self.road.lanes) - 1)
        valid[:, 1:] &= ~driving[:, None]
        valid[rows, index] = True
        made = {"x": x, "y": y, "speed": speed, "heading": heading, "acceleration": acceleration}
        like = vehicles.x
        floats = {
            name: torch.as_tensor(value).to(like.device, like.dtype) for name, value in made.items()
        }
        moved = vehicles.with_(
            **floats,
            target_lane=torch.as_tensor(target).to(like.device),
            valid=torch.as_tensor(valid).to(like.device),
        )
        return moved.where(torch.as_tensor(driving).to(like.device), vehicles).with_first(
            vehicles.at(EGO_INDEX)
        )


class _Simulation:
    """The roads in SUMO, and the state of their rows outside of it; [N] or [N, M]."""

    def __init__(self, roads: SumoRoads, n: int, m: int) -> None:
        self.roads = roads
        self.keys, self.ended = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool)
        #: The vehicles (:func:`_arrays`) before and after the last step.
        self.inputs: Any = None
        self.outputs: Any = None
        self.desired_speed, self.pace_turns, self.pace_phase = (
            np.ones((n, m)),
            np.zeros((n, m)),
            np.zeros((n, m)),
        )


def _arrays(vehicles: Vehicles) -> Any:
    """The vehicles with arrays on the CPU as fields; the tensors must not be written to afterwards."""
    return Vehicles(*(field.detach().cpu().numpy() for field in vehicles))  # type: ignore[arg-type]


def _same(seen: Any, other: Any, names: Iterable[str]) -> NDArray[np.bool_]:
    """Rows [N] in which these fields of the others are as in ``other``; none without it."""
    if other is None:
        return np.zeros(len(seen.x), dtype=bool)
    return np.all(
        [(getattr(seen, name) == getattr(other, name))[:, 1:].all(1) for name in names], axis=0
    )


def _driver(u: Array, seen: Any, row: int, i: int) -> SumoDriver:
    """A driver by the uniforms ``u`` in [0, 1)."""
    ranges, emergency_decel = (LORRIES, 7.0) if seen.length[row, i] >= LORRY_M else (CARS, 9.0)
    columns = enumerate(ranges.items(), _TAU)
    drawn = {name: low + float(u[column]) * (high - low) for column, (name, (low, high)) in columns}
    own = {
        name: float(getattr(seen, name)[row, i]) for name in ("desired_speed", "length", "width")
    }
    return SumoDriver(**own, **drawn, emergency_decel=emergency_decel)
