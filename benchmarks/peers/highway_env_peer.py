"""The scene in HighwayEnv: its own IDM vehicles on its own road, with Table V's parameters.

Written against highway-env 1.10 to 1.12. What has to be set so that the drivers are the same:

- ``COMFORT_ACC_MAX``, ``COMFORT_ACC_MIN`` (negative), ``TIME_WANTED``, ``DELTA`` and ``DISTANCE_WANTED`` are Table V.
  ``DISTANCE_WANTED`` is from centre to centre and so includes a length.
- ``ACC_MAX`` (6 m/s2) bounds the acceleration both ways; here Table V's 20 m/s2.
- ``target_speed`` is the desired speed, but the lane's ``speed_limit`` (20 or 30 m/s as it comes) cuts it.
- lane changes are off; the step is 0.1 s rather than the environments' 1/15 s.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np

from benchmarks.peers.scene import DESIRED_SPEED_MPS, LENGTH_M, ROAD_M, Scene, Trace
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V, IdmParameters


class Distances(Enum):
    """What HighwayEnv's drivers take for the distance to their leader."""

    #: As it comes: from centre to centre, with one vehicle's length in the minimum gap.
    CENTRES = LENGTH_M
    #: Points instead of bodies, as far apart as the bumpers are: HighwayEnv's equations see the net gap.
    BUMPERS = 0.0


def driver_class(distances: Distances, idm: IdmParameters) -> Any:
    """``IDMVehicle`` with the parameters ``idm`` and vehicles of 4.5 m."""
    from highway_env.vehicle.behavior import IDMVehicle

    class Driver(IDMVehicle):
        LENGTH = LENGTH_M
        ACC_MAX = -idm.min_acceleration
        COMFORT_ACC_MAX = idm.max_acceleration
        COMFORT_ACC_MIN = -idm.comfortable_deceleration
        DISTANCE_WANTED = idm.min_gap_m + distances.value
        TIME_WANTED = idm.headway_s
        DELTA = 4.0

    return Driver


def build(scene: Scene, distances: Distances, idm: IdmParameters) -> Any:
    """A HighwayEnv road with the vehicles of ``scene`` at their places, the foremost first."""
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.kinematics import Vehicle

    network = RoadNetwork.straight_road_network(lanes=1, length=ROAD_M, speed_limit=2.0 * DESIRED_SPEED_MPS)
    road = Road(network, np_random=np.random.RandomState(0))
    driver = driver_class(distances, idm)
    squeezed = scene.positions_m() + squeeze(scene, distances)
    for rank, (x, speed) in enumerate(zip(squeezed, scene.speeds_mps)):
        if rank == 0 and scene.leader:
            vehicle = Vehicle(road, [x, 0.0], speed=speed)
        else:
            vehicle = driver(
                road, [x, 0.0], speed=speed, target_speed=DESIRED_SPEED_MPS, enable_lane_change=False, timer=1.0
            )
        # Its crash physics would push the points apart that stand for bodies.
        vehicle.check_collisions = distances is Distances.CENTRES
        road.vehicles.append(vehicle)
    return road


def squeeze(scene: Scene, distances: Distances) -> np.ndarray:
    """How far forward each vehicle is drawn so that centres are as far apart as bumpers should be, m, [M]."""
    rank = np.arange(len(scene.speeds_mps))
    return rank * (LENGTH_M - distances.value)


def drive(
    scene: Scene,
    distances: Distances = Distances.BUMPERS,
    dt: float = PHYSICS_STEP_S,
    idm: IdmParameters = TABLE_V,
) -> Trace:
    """Drive ``scene`` with HighwayEnv at steps of ``dt`` seconds; positions in the trace are the bodies' centres."""
    road = build(scene, distances, idm)
    leader = scene.leader_speeds(dt) if scene.leader else None
    speeds, positions = [_speeds(road)], [_positions(road)]
    for step in range(scene.steps(dt)):
        road.act()
        if leader is not None:
            road.vehicles[0].act({"steering": 0.0, "acceleration": (leader[step + 1] - leader[step]) / dt})
        road.step(dt)
        speeds.append(_speeds(road))
        positions.append(_positions(road))
    return Trace(np.array(speeds), np.array(positions) - squeeze(scene, distances))


def _speeds(road: Any) -> list[float]:
    return [vehicle.speed for vehicle in road.vehicles]


def _positions(road: Any) -> list[float]:
    return [vehicle.position[0] for vehicle in road.vehicles]
