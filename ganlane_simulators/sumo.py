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
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.settings.episode import SpawnParameters
from ganlane.settings.traffic import SumoTrafficConfig
from ganlane.sim.dynamics import (
    STEERING,
    SteeringParameters,
    drive,
    ego_scene,
)
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.scenes import Scenes
from ganlane.sim.spawn import TABLE_II, RandomScenes
from ganlane.sim.state import (
    Road,
    Vehicles,
    body_lanes,
    presence,
    with_target,
)
from ganlane.traffic.base import Memory, Moved, TrafficModule
from ganlane_simulators.sumo_roads import (
    Array,
    Place,
    SumoDriver,
    SumoRoads,
    import_libsumo,
)

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
_IS_LORRY = 0
_DESIRED = 1
_TAU = 2
_PACE_PERIOD = 6
_PACE_PHASE = 7


Flags = NDArray[np.bool_]


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
        columns = [
            Purpose.FOREIGN_DRIVER + _IS_LORRY,
            Purpose.FOREIGN_DRIVER + _DESIRED,
        ]
        chosen, desired = uniform(key, 0, self.vehicles, columns).unbind(-1)
        is_other = torch.arange(self.vehicles, device=key.device) != EGO_INDEX
        is_lorry = (chosen < self.share) & is_other
        lorry_m = max(self.length_m, self.cars.parameters.length_m)
        length = torch.where(is_lorry, lorry_m, scene.length)
        lorry_mps = (22.0 + desired * (25.0 - 22.0)).to(dtype)
        desired_speed = torch.where(is_lorry, lorry_mps, scene.desired_speed)
        # Each centre moves forward by what those behind it in its lane and its own rear half are
        # longer.
        extra = length - scene.length
        same = scene.target_lane[:, :, None] == scene.target_lane[:, None, :]
        behind = scene.x[:, None, :] < scene.x[:, :, None]
        x = scene.x + ((extra[:, None, :] * (same & behind)).sum(-1) + 0.5 * extra)
        return scene.with_(
            x=x - x[:, EGO_INDEX, None],
            length=length,
            desired_speed=desired_speed,
        )


#: Ranges (low, high) of the drivers' parameters, s, m/s2, m, in the order of their columns. SUMO's
#: own values lie within.
CARS = {
    "tau": (0.9, 1.6),
    "accel": (1.5, 3.0),
    "decel": (3.5, 5.0),
    "min_gap": (1.5, 3.0),
}
LORRIES = {
    "tau": (1.2, 2.0),
    "accel": (0.8, 1.3),
    "decel": (3.0, 4.5),
    "min_gap": (2.0, 3.5),
}


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
        import_libsumo()
        if self.road.ring_m is not None:
            raise UserError(
                f"traffic sumo: a ring of {self.road.ring_m:g} m; SUMO's roads here are straight."
            )
        self.idm = idm
        self.steering = steering
        self.spawn = spawn
        self.truck_share = truck_share
        self.truck_length_m = truck_length_m
        self.lane_change_s = lane_change_s
        self.keep_right = keep_right
        self.speed_wander = speed_wander
        self._simulation: _Simulation | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without the simulation: a copy, or another process, starts its own."""
        return {**self.__dict__, "_simulation": None}

    def scenes(
        self,
        vehicles: int,
        ego_visibility: int = Visibility.BODY,
        ego_desired_speed_mps: float = 25.0,
    ) -> Scenes:
        """Table II with lorries: as many as ``env.truck_share`` says, or else ``truck_share``."""
        cars = RandomScenes(
            self.road,
            vehicles,
            self.spawn,
            ego_visibility,
            self.visibility,
        )
        if self.spawn.truck_share > 0:
            return cars
        return LorryScenes(cars, self.truck_share, self.truck_length_m)

    def move(
        self,
        vehicles: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """One step of SUMO; rows at step 0 are set up anew first. Only the ego is steered by us."""
        fresh = (step == 0).cpu().numpy()
        # libsumo is called vehicle by vehicle, so everything is NumPy or plain numbers from here.
        before = _arrays(vehicles)
        now = self._running(before, fresh)
        driving = self._check(now, before, fresh, key.cpu().numpy())
        for row in np.flatnonzero(fresh).tolist():
            self._start(now, row, before, key)
        # Where the egos will be at t + 0.1 s, as the environment moves them.
        acceleration = following_acceleration(ego_scene(vehicles, self.road), self.idm)[:, 0]
        line = self.road.centre_of(vehicles.target_lane[:, :1], vehicles.y.dtype)[:, 0]
        steering = memory["steering"]
        ego, wheels = drive(
            vehicles.at(EGO_INDEX),
            acceleration,
            steering[:, 0],
            line,
            self.dt,
            self.steering,
        )
        self._lead_egos(now.roads, driving, ego, before)
        self._wander(
            now.roads,
            driving,
            before,
            key.cpu(),
            step.cpu().numpy(),
        )
        now.roads.step()
        moved = self._moved(now.roads, driving, vehicles, before)
        now.before = before
        now.after = _arrays(moved)
        return moved, {"steering": torch.cat((wheels[:, None], steering[:, 1:]), dim=1)}

    def _running(self, before: Any, fresh: Flags) -> _Simulation:
        """The running simulation, or a new one if all episodes begin."""
        now = self._simulation
        if now is not None and now.roads.is_open and now.shape == before.x.shape:
            return now
        if not fresh.all():
            raise UserError(
                "traffic sumo: the simulation of this episode is gone, since a process has one "
                "SUMO and somebody else has used it meanwhile; finish one environment before the "
                "next one starts."
            )
        assert isinstance(self.road.lanes, int)
        n = len(before.x)
        width = float(self.road.lane_width_m)
        roads = SumoRoads(
            n,
            self.road.lanes,
            width,
            self.lane_change_s,
            self.keep_right,
        )
        no_keys = np.zeros(n, np.int64)
        none_ended = np.zeros(n, bool)
        self._simulation = _Simulation(roads, before.x.shape, no_keys, none_ended)
        return self._simulation

    def _check(
        self,
        now: _Simulation,
        before: Any,
        fresh: Flags,
        key: NDArray[np.int64],
    ) -> Flags:
        """Which rows drive in this step.

        A row that has ended comes again as it was, and is taken off the road. With ``env.recycle``
        some of the others may be elsewhere along the road.

        Raises:
            UserError: the state of a row is neither the one that SUMO left nor one that has ended.
        """
        # What the last step left tells whether this state continues it.
        same_episode = key == now.keys
        in_lane = same_episode & ~now.ended & _same(before, now.after, "y", "speed", "valid")
        follows = fresh | (in_lane & _same(before, now.after, "x"))
        # The environment goes on computing ended rows until the decision is over.
        again = same_episode & _same(before, now.before, "x", "y", "speed", "valid")
        waits = again & ~follows
        shifted = in_lane & ~follows & ~waits
        if not (follows | waits | shifted).all():
            raise UserError(
                "traffic sumo: this state is not the one that SUMO left (it was loaded, copied or "
                "changed), and SUMO can only drive on from where it is; start the episode again."
            )
        for row in np.flatnonzero(waits & ~now.ended).tolist():
            now.roads.clear(row)
        # Recycled vehicles were put elsewhere along the road: SUMO follows.
        for row in np.flatnonzero(shifted).tolist():
            for i in np.flatnonzero(before.x[row] != now.after.x[row]).tolist():
                if i != EGO_INDEX:
                    now.roads.replace(row, i - 1, self._place(before, row, i))
        now.ended = waits
        return follows | shifted

    def _place(
        self,
        vehicles: Any,
        row: int,
        i: int,
    ) -> Place:
        """Where vehicle ``i`` of a row is."""
        lane = round(float(vehicles.y[row, i]) / float(self.road.lane_width_m))
        # A body may lean over the edge of the road; SUMO knows only lanes.
        lane = min(max(lane, 0), int(self.road.lanes) - 1)
        return Place(
            lane,
            float(vehicles.x[row, i]),
            float(vehicles.speed[row, i]),
        )

    def _start(
        self,
        now: _Simulation,
        row: int,
        vehicles: Any,
        key: Tensor,
    ) -> None:
        """A new episode on a highway."""
        m = vehicles.x.shape[1]
        now.roads.clear(row)
        purposes = [Purpose.FOREIGN_DRIVER + _TAU + k for k in range(len(CARS))]
        # Every driver's parameters follow from the episode, not from when SUMO drew them.
        u = uniform(key[row : row + 1].cpu(), 0, m, purposes, torch.float64)[0].numpy()
        drivers = []
        for i in range(1, m):
            there = vehicles.valid[row, i]
            drivers.append(_driver(u[i], vehicles, row, i) if there else None)
        now.roads.fill(
            row,
            drivers,
            [self._place(vehicles, row, i) for i in range(1, m)],
        )
        now.keys[row], now.ended[row] = int(key[row]), False

    def _lead_egos(
        self,
        roads: SumoRoads,
        driving: Flags,
        ego: Vehicles,
        before: Any,
    ) -> None:
        """The stand-ins, ordinary cars for SUMO's drivers, follow the egos."""
        # [N, 1]: the environment's functions on a batch of single vehicles.
        one = ego.part((slice(None), None))
        body = body_lanes(one, self.road)
        lanes = presence(one, self.road, body, with_target(body, one))
        low, high, next_x = (field[:, 0].tolist() for field in (lanes.low, lanes.high, one.x))
        now = before.at(EGO_INDEX)
        for row in np.flatnonzero(driving).tolist():
            size = float(now.length[row]), float(now.width[row])
            driver = SumoDriver(
                float(now.desired_speed[row]),
                *size,
                1.0,
                2.6,
                4.5,
                2.5,
                9.0,
            )
            here = Place(0, float(now.x[row]), float(now.speed[row]))
            there = range(int(low[row]), int(high[row]) + 1) if now.valid[row] else range(0)
            roads.lead_ego(row, there, driver, here, next_x[row])

    def _wander(
        self,
        roads: SumoRoads,
        driving: Flags,
        before: Any,
        key: Tensor,
        step: NDArray[np.int64],
    ) -> None:
        """Once a second drivers change their desired speeds, each along its own sine."""
        rows = np.flatnonzero(driving & (step % _PACE_STEPS == 0)).tolist()
        if self.speed_wander == 0.0 or not rows:
            return
        purposes = [
            Purpose.FOREIGN_DRIVER + _PACE_PERIOD,
            Purpose.FOREIGN_DRIVER + _PACE_PHASE,
        ]
        u = uniform(key, 0, before.x.shape[1], purposes, torch.float64).numpy()
        # Turns of the sine so far, with a period of 20 to 60 s and a random phase.
        turns = step[:, None] * (0.1 / (20.0 + 40.0 * u[..., 0])) + u[..., 1]
        factor = 1.0 + self.speed_wander * np.sin(2.0 * np.pi * turns)
        speeds = before.desired_speed * factor
        for row in rows:
            for name, speed in zip(roads.names[row], speeds[row, 1:].tolist()):
                if name:
                    roads.set_desired_speed(name, speed)

    def _moved(
        self,
        roads: SumoRoads,
        driving: Flags,
        vehicles: Vehicles,
        before: Any,
    ) -> Vehicles:
        """SUMO's state as our fields; the egos, and rows that do not drive, stay as they are."""
        row, other, front, new_speed = roads.read()
        at = row, other + 1
        # SUMO tells where the front bumper is; ours is the centre.
        new_x = front[:, 0] - 0.5 * before.length[at]
        new_y = front[:, 1]
        dx = new_x - before.x[at]
        dy = new_y - before.y[at]
        angle = np.arctan2(dy, np.maximum(dx, 1e-6))
        # The lane that a vehicle keeps, or is moving to: the next centre in the direction in which
        # it moves.
        lane = new_y / float(self.road.lane_width_m)
        close = 1e-3
        left = np.ceil(lane - close)
        right = np.floor(lane + close)
        lane = np.where(
            dy > _SIDEWAYS_M,
            left,
            np.where(dy < -_SIDEWAYS_M, right, np.round(lane)),
        )
        new = {
            "x": new_x,
            "y": new_y,
            "speed": new_speed,
            "heading": np.clip(angle, -_STEEPEST_RAD, _STEEPEST_RAD),
            "acceleration": (new_speed - before.speed[at]) / self.dt,
            "target_lane": np.clip(lane, 0, int(self.road.lanes) - 1),
            "valid": True,
        }
        fields = {}
        for name, values in new.items():
            field = getattr(before, name).copy()
            if name in (
                "acceleration",
                "valid",
            ):  # of who has come to the end of the road
                field[driving, 1:] = 0
            field[at] = values
            fields[name] = torch.as_tensor(field).to(vehicles.x.device)
        return vehicles.with_(**fields)


@dataclass
class _Simulation:
    """The roads in SUMO, and what is remembered of their rows.

    Attributes:
        roads: N highways.
        shape: N and M.
        keys: [N] of the episodes under way.
        ended: [N] whether a row has ended and is off the road.
        before, after: the vehicles (:func:`_arrays`) before and after the last step.
    """

    roads: SumoRoads
    shape: tuple[int, int]
    keys: NDArray[np.int64]
    ended: Flags
    before: Any = None
    after: Any = None


def _arrays(vehicles: Vehicles) -> Any:
    """The vehicles with arrays on the CPU as fields; the tensors must not be written to later."""
    return Vehicles(*(field.detach().cpu().numpy() for field in vehicles))  # type: ignore[arg-type]


def _same(
    vehicles: Any,
    other: Any,
    *names: str,
) -> Flags:
    """Rows [N] in which these fields of the others are as in ``other``; none without it."""
    same = np.full(len(vehicles.x), other is not None)
    for name in names if other is not None else ():
        same &= (getattr(vehicles, name) == getattr(other, name))[:, 1:].all(1)
    return same


def _driver(
    u: Array,
    vehicles: Any,
    row: int,
    i: int,
) -> SumoDriver:
    """The driver of vehicle ``i`` of a row by the uniforms ``u`` in [0, 1)."""
    is_lorry = vehicles.length[row, i] >= LORRY_M
    ranges, emergency_decel = (LORRIES, 7.0) if is_lorry else (CARS, 9.0)
    drawn = [low + float(u[k]) * (high - low) for k, (low, high) in enumerate(ranges.values())]
    names = ("desired_speed", "length", "width")
    body = [float(getattr(vehicles, name)[row, i]) for name in names]
    return SumoDriver._make((*body, *drawn, emergency_decel))
