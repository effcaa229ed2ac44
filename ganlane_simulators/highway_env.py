"""``traffic=highway_env``: the others are HighwayEnv's, the ego is ours."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX
from ganlane.settings.driving import Visibility
from ganlane.sim.random import Purpose, Stream, uniform
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import Memory, Moved, TrafficModule

#: Column of :attr:`ganlane.sim.random.Purpose.FOREIGN_DRIVER`, after those of SUMO's drivers.
_EXPONENT = 8
#: HighwayEnv's own bounds for the exponent of a driver's free acceleration
#: (``IDMVehicle.DELTA_RANGE``).
_LOWEST_EXPONENT = 3.5
_HIGHEST_EXPONENT = 4.5
#: Start and end of HighwayEnv's lanes, m, and their speed limit, m/s, above all desired speeds.
_FROM_M = -10_000.0
_TO_M = 200_000.0
_LIMIT_MPS = 70.0


class HighwayEnvTraffic(TrafficModule):
    """The others driven by HighwayEnv's ``IDMVehicle``: its IDM, MOBIL, steering and Euler step.

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
                f"traffic highway_env: a ring of {self.road.ring_m:g} m; HighwayEnv's roads here "
                "are straight."
            )
        self._highway = _Highway(self.road)

    def __getstate__(self) -> dict[str, Any]:
        """Without HighwayEnv's objects, whose class is made at run time."""
        return {**self.__dict__, "_highway": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """With new ones."""
        super().__setstate__(state)
        self._highway = _Highway(self.road)

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """HighwayEnv's staggering of drivers by their initial positions."""
        return {"timer": torch.remainder((vehicles.x + vehicles.y) * torch.pi, 1.0)}

    def move(
        self,
        vehicles: Vehicles,
        memory: Memory,
        key: Tensor,
        step: Tensor,
    ) -> Moved:
        """Row by row: write HighwayEnv's objects, let them act and step, read them."""
        like = vehicles.x
        m = vehicles.x.shape[1]
        u = uniform(
            key,
            0,
            m,
            [Purpose.FOREIGN_DRIVER + _EXPONENT],
            like.dtype,
        )[..., 0]
        exponent = _LOWEST_EXPONENT + (_HIGHEST_EXPONENT - _LOWEST_EXPONENT) * u
        body = _float64(vehicles.x, vehicles.y, vehicles.heading, vehicles.speed)
        size = _float64(vehicles.length, vehicles.width)
        driver = _float64(vehicles.desired_speed, exponent, memory["timer"])
        target = vehicles.target_lane.cpu().numpy().copy()
        valid = vehicles.valid.cpu().numpy()
        ego_signals = (vehicles.visibility[:, EGO_INDEX] == int(Visibility.SIGNALLED)).tolist()
        for row, signals in enumerate(ego_signals):
            self._highway.put(
                valid[row],
                body[row],
                size[row],
                driver[row],
                target[row],
                signals,
            )
            self._highway.drive(self.dt, body[row], driver[row], target[row])
        x, y, heading, speed = torch.as_tensor(body).to(like.device, like.dtype).unbind(-1)
        moved = vehicles.with_(
            x=x,
            y=y,
            heading=heading,
            speed=speed,
            acceleration=(speed - vehicles.speed) / self.dt,
            target_lane=torch.as_tensor(target).to(like.device),
        )
        timer = torch.as_tensor(driver[..., 2]).to(like.device, like.dtype)
        return moved.with_first(vehicles.at(EGO_INDEX)), {"timer": timer}


def _float64(*fields: Tensor) -> NDArray[np.float64]:
    """Fields [N, M] as one array [N, M, F] on the CPU."""
    return torch.stack(fields, dim=-1).double().cpu().numpy()


class _Highway:
    """One road of HighwayEnv whose objects are filled with one row after another."""

    def __init__(self, ours: Road) -> None:
        try:
            from highway_env.road.lane import StraightLane
            from highway_env.road.road import Road as TheirRoad
            from highway_env.road.road import RoadNetwork
            from highway_env.vehicle.behavior import IDMVehicle
            from highway_env.vehicle.controller import (
                ControlledVehicle,
            )
        except ModuleNotFoundError as error:
            raise UserError(
                f"traffic highway_env: highway-env is not installed ({error}); "
                "pip install 'ganlane[bench]' brings it."
            ) from error
        assert isinstance(ours.lanes, int)

        class Lane(StraightLane):
            """A straight lane along x; the same numbers as its base class's, without arrays."""

            def local_coordinates(self, position: Any) -> tuple[float, float]:
                return float(position[0]) - _FROM_M, float(position[1]) - self.start[1]

        network = RoadNetwork()
        width = float(ours.lane_width_m)
        for k in range(ours.lanes):
            y = k * width
            lane = Lane(
                [_FROM_M, y],
                [_TO_M, y],
                width=width,
                speed_limit=_LIMIT_MPS,
            )
            network.add_lane("a", "b", lane)
        self.road = TheirRoad(network, np_random=np.random.RandomState(0))
        self._new_driver = IDMVehicle
        # A ControlledVehicle as in HighwayEnv's own environments: the others' MOBIL asks for its
        # target speed.
        self._cars = [ControlledVehicle(self.road, [0.0, 0.0])]
        self._there: list[int] = []

    def put(
        self,
        valid: Any,
        body: Any,
        size: Any,
        driver: Any,
        target: Any,
        ego_signals: bool,
    ) -> None:
        """Write one row into HighwayEnv's objects.

        Args:
            valid: who is there, [M] bool.
            body: x, y, heading, speed, [M, 4] float64.
            size: length, width, [M, 2].
            driver: desired speed, exponent, timer, [M, 3].
            target: lanes, [M] int64.
            ego_signals: whether the others see the ego's target lane.
        """
        while len(self._cars) < len(valid):
            self._cars.append(self._new_driver(self.road, [0.0, 0.0], timer=1.0))
        self._there = np.flatnonzero(valid).tolist()
        self.road.vehicles = [self._cars[i] for i in self._there]
        for i in self._there:
            car = self._cars[i]
            car.position = body[i, :2].copy()
            car.heading, car.speed = body[i, 2:].tolist()
            car.LENGTH, car.WIDTH = size[i].tolist()
            car.on_state_update()
            car.target_speed, car.DELTA, car.timer = driver[i].tolist()
            car.target_lane_index = ("a", "b", int(target[i]))
        if not ego_signals:
            self._cars[EGO_INDEX].target_lane_index = self._cars[EGO_INDEX].lane_index

    def drive(
        self,
        dt: float,
        body: Any,
        driver: Any,
        target: Any,
    ) -> None:
        """Move the others by ``dt`` seconds, and read them back into the arrays of :meth:`put`."""
        self.road.act()
        for i in self._there:
            if i != EGO_INDEX:
                car = self._cars[i]
                car.step(dt)
                body[i] = (
                    *car.position,
                    car.heading,
                    max(car.speed, 0.0),
                )
                driver[i, 2] = car.timer
                target[i] = car.target_lane_index[2]
