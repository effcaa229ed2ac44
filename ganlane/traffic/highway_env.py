"""``traffic=highway_env``: the others are HighwayEnv's, the ego is ours."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.settings.driving import Visibility
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import Memory, Moved, TrafficModule, require

#: Fields of a vehicle that HighwayEnv moves, in the order in which they are handed over.
_MOVING = ("x", "y", "heading", "speed")
#: Column of :attr:`ganlane.sim.random.Purpose.FOREIGN_DRIVER`, after those of SUMO's drivers.
_EXPONENT = 8
#: HighwayEnv's own bounds for the exponent of a driver's free acceleration
#: (``IDMVehicle.DELTA_RANGE``).
_EXPONENTS = (3.5, 4.5)
#: Start and end of HighwayEnv's lanes, m, and their speed limit, m/s, above all desired speeds.
_FROM_M, _TO_M, _LIMIT_MPS = -10_000.0, 200_000.0, 70.0


def _module(name: str) -> Any:
    return require(f"highway_env.{name}", "highway_env", "highway-env", "bench")


class HighwayEnvTraffic(TrafficModule):
    """The others driven by HighwayEnv's ``IDMVehicle``: its IDM, MOBIL and steering, its explicit
    Euler step.

    The parameters are HighwayEnv's own (1.5 s, 3 and -5 m/s2, distances from centre to centre, an
    egoistic MOBIL once a second); desired speeds are Table II's, and the exponent differs from
    driver to driver as HighwayEnv draws it. Its vehicles do not react to crashes here. One whose
    speed would fall below 0 stops.

    HighwayEnv's state of a vehicle is in ``vehicles`` and in this module's memory (the time since
    the driver's last lane change decision, s), and is written into HighwayEnv's objects in every
    step. So this traffic is a function of the state like the others: an episode is the same in any
    batch and can be saved and branched. It is slow: a Python loop over rows and vehicles.

    Raises:
        UserError: highway-env is not installed, or the road is a ring.
    """

    #: HighwayEnv's drivers see a vehicle in a lane from 1 m beyond its edge on.
    visibility = Visibility.BODY
    memory_fields = {"timer": ((), None)}  # noqa: RUF012

    def __init__(self, road: Road | None = None, stream: int = Stream.TRAIN) -> None:
        super().__init__(road, stream)
        if self.road.ring_m is not None:
            raise UserError(
                f"traffic highway_env: a ring of {self.road.ring_m:g} m; HighwayEnv's roads here are straight."
            )
        self._highway = _Highway(self.road)

    def __getstate__(self) -> dict[str, Any]:
        """Without HighwayEnv's objects, whose class is made at run time."""
        return {**self.__dict__, "_highway": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """With new ones."""
        super().__setstate__(state)
        self._highway = _Highway(self.road)

    def compile_graphs(self) -> None:
        """Nothing can be compiled."""

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """HighwayEnv's staggering of drivers by their initial positions."""
        return {"timer": torch.remainder((vehicles.x + vehicles.y) * torch.pi, 1.0)}

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Row by row: write HighwayEnv's objects, let it act and step, read them."""
        m, like = vehicles.x.shape[1], vehicles.x
        fields = (
            torch.stack([getattr(vehicles, name) for name in _MOVING], dim=-1)
            .double()
            .cpu()
            .numpy()
        )
        low, high = _EXPONENTS
        exponent = (
            low
            + (high - low)
            * uniform(key, 0, m, [Purpose.FOREIGN_DRIVER + _EXPONENT], like.dtype)[..., 0]
        )
        driver = (
            torch.stack((vehicles.desired_speed, exponent, memory["timer"]), dim=-1)
            .double()
            .cpu()
            .numpy()
        )
        size = torch.stack((vehicles.length, vehicles.width), dim=-1).double().cpu().numpy()
        target, valid = vehicles.target_lane.cpu().numpy().copy(), vehicles.valid.cpu().numpy()
        signals = (vehicles.visibility[:, EGO_INDEX] == int(Visibility.SIGNALLED)).tolist()
        timer = driver[..., 2]
        for row in range(len(fields)):
            present = np.flatnonzero(valid[row])
            mine = (fields[row], size[row], driver[row], target[row])
            self._highway.drive(present, *mine, bool(signals[row]), self.dt)
        moving = torch.as_tensor(fields).to(like.device, like.dtype)
        moved = vehicles.with_(**dict(zip(_MOVING, moving.unbind(-1))))
        acceleration = (moved.speed - vehicles.speed) / self.dt
        moved = moved.with_(
            acceleration=acceleration, target_lane=torch.as_tensor(target).to(like.device)
        )
        return moved.with_first(vehicles.at(EGO_INDEX)), {
            "timer": torch.as_tensor(timer).to(like.device, like.dtype)
        }


class _Highway:
    """One road of HighwayEnv whose objects are filled with one row after another."""

    def __init__(self, ours: Road) -> None:
        assert isinstance(ours.lanes, int)
        road, width = _module("road.road"), float(ours.lane_width_m)

        class Lane(_module("road.lane").StraightLane):  # type: ignore[misc]
            """A straight lane along x; the same numbers as its base class's, without arrays."""

            def local_coordinates(self, position: Any) -> tuple[float, float]:
                return float(position[0]) - _FROM_M, float(position[1]) - self.offset

        network = road.RoadNetwork()
        for k in range(ours.lanes):
            y = k * width
            lane = Lane([_FROM_M, y], [_TO_M, y], width=width, speed_limit=_LIMIT_MPS)
            lane.offset = y
            network.add_lane("a", "b", lane)
        self.road = road.Road(network, np_random=np.random.RandomState(0))
        self._driver = _module("vehicle.behavior").IDMVehicle
        # A ControlledVehicle as in HighwayEnv's own environments: the others' MOBIL asks for its
        # target speed.
        ego = _module("vehicle.controller").ControlledVehicle
        self._cars = [ego(self.road, [0.0, 0.0])]

    def drive(
        self,
        present: Any,
        fields: Any,
        size: Any,
        driver: Any,
        target: Any,
        ego_signals: bool,
        dt: float,
    ) -> None:
        """Move the vehicles with the indices ``present`` of one row by ``dt`` seconds, in place.

        Args:
            present, fields: indices; x, y, heading, speed, [M, 4] float64.
            size, driver: length, width, [M, 2]; desired speed, exponent, timer, [M, 3].
            target, ego_signals: lanes, [M] int64; whether the others see the ego's target lane.
            dt: s.
        """
        while len(self._cars) < len(fields):
            self._cars.append(self._driver(self.road, [0.0, 0.0], timer=1.0))
        self.road.vehicles = [self._cars[i] for i in present]
        for i in present:
            vehicle = self._cars[i]
            x, y, vehicle.heading, vehicle.speed = fields[i].tolist()
            vehicle.position = np.array([x, y])
            vehicle.LENGTH, vehicle.WIDTH = size[i].tolist()
            vehicle.on_state_update()
            vehicle.target_speed, vehicle.DELTA, vehicle.timer = driver[i].tolist()
            vehicle.target_lane_index = ("a", "b", int(target[i]))
        if not ego_signals:
            self._cars[EGO_INDEX].target_lane_index = self._cars[EGO_INDEX].lane_index
        self.road.act()
        for i in present:
            if i != EGO_INDEX:
                vehicle = self._cars[i]
                vehicle.step(dt)
                fields[i] = (*vehicle.position, vehicle.heading, max(vehicle.speed, 0.0))
                driver[i, 2] = vehicle.timer
                target[i] = vehicle.target_lane_index[2]
