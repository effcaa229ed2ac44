"""Scenes that test a driver: cut-in, stalled car, stop-and-go wave, blocked lane. m, m/s; the ego comes first.

Each is a function from a few numbers to the rows of a :class:`~ganlane.sim.fixed_scene.FixedScene`.
"""

from __future__ import annotations

from itertools import accumulate, chain

from ganlane.errors import UserError
from ganlane.parameters.driving import IdmParameters
from ganlane.sim.fixed_scene import SceneVehicle
from ganlane.sim.idm import TABLE_V

LENGTH_M = 4.5
#: Desired speed of a vehicle that has broken down; 0 is no speed that IDM knows.
STALLED_MPS = 0.001
#: A broken-down car stands this far right of its lane's middle. Drivers who are not where they want to be start no
#: lane change, so MOBIL's politeness does not make it creep across the road to let the others pass.
ASKEW_M = 0.6


def stalled(x_m: float, lane: int, lane_width_m: float = 4.0) -> SceneVehicle:
    """A vehicle that has broken down in ``lane``."""
    return SceneVehicle(x_m, y_m=lane * lane_width_m - ASKEW_M, desired_speed_mps=STALLED_MPS)


def cut_in(
    gap_m: float = 20.0,
    speed_mps: float = 20.0,
    cutter_speed_mps: float = 17.0,
    lanes: int = 3,
    desired_speed_mps: float = 25.0,
) -> tuple[SceneVehicle, ...]:
    """A slower vehicle one lane to the left, ``gap_m`` ahead of the ego's bumper, moves into its lane at once.

    A leader 80 m ahead of the ego, a follower 35 m behind it, one behind the vehicle that cuts in, and (on three
    lanes) one beside the ego to the right make braking the nearest way out.
    """
    _at_least(lanes, 2, "cut_in")
    own = lanes - 2
    right = (SceneVehicle(-8.0, own - 1, speed_mps, speed_mps),) if own > 0 else ()
    return (
        SceneVehicle(0.0, own, speed_mps, desired_speed_mps),
        SceneVehicle(gap_m + LENGTH_M, own + 1, cutter_speed_mps, cutter_speed_mps, target_lane=own),
        SceneVehicle(80.0, own, speed_mps, 22.0),
        SceneVehicle(-35.0, own, speed_mps, 22.0),
        SceneVehicle(-40.0, own + 1, speed_mps, 24.0),
        *right,
    )


def stalled_car(
    distance_m: float = 200.0,
    speed_mps: float = 20.0,
    spacing_m: float = 120.0,
    lanes: int = 3,
    desired_speed_mps: float = 25.0,
    lane_width_m: float = 4.0,
) -> tuple[SceneVehicle, ...]:
    """A broken-down vehicle ``distance_m`` ahead in the ego's lane, the rightmost.

    A vehicle follows the ego, and in the next lane (if any) five pass, ``spacing_m`` from each other.
    """
    beside = () if lanes == 1 else _column(1, 5, 0.5 * spacing_m, spacing_m, speed_mps, 22.0)
    return (
        SceneVehicle(0.0, 0, speed_mps, desired_speed_mps),
        stalled(distance_m, 0, lane_width_m),
        SceneVehicle(-50.0, 0, speed_mps, 22.0),
        *beside,
    )


def blocked_lane(
    distance_m: float = 250.0,
    standing: int = 3,
    speed_mps: float = 15.0,
    spacing_m: float = 60.0,
    lanes: int = 2,
    desired_speed_mps: float = 25.0,
    lane_width_m: float = 4.0,
) -> tuple[SceneVehicle, ...]:
    """The rightmost lane is closed by ``standing`` vehicles in a row, from ``distance_m`` on; traffic passes beside.

    In each of the other lanes six vehicles, ``spacing_m`` from each other: the ego has to find a gap.
    """
    _at_least(lanes, 2, "blocked_lane")
    closed = (stalled(distance_m + (LENGTH_M + 1.5) * k, 0, lane_width_m) for k in range(standing))
    beside = (_column(lane, 6, 1.3 * spacing_m, spacing_m, speed_mps, 20.0) for lane in range(1, lanes))
    return (
        SceneVehicle(0.0, 0, speed_mps, desired_speed_mps),
        *closed,
        SceneVehicle(-50.0, 0, speed_mps, 20.0),
        *chain.from_iterable(beside),
    )


def _column(
    lane: int, vehicles: int, first_m: float, spacing_m: float, speed_mps: float, desired_speed_mps: float
) -> tuple[SceneVehicle, ...]:
    """Vehicles one behind the other, from ``first_m`` backwards."""
    return tuple(SceneVehicle(first_m - spacing_m * k, lane, speed_mps, desired_speed_mps) for k in range(vehicles))


def stop_and_go(
    waves: int = 2,
    per_wave: int = 5,
    speed_mps: float = 10.0,
    lanes: int = 2,
    desired_speed_mps: float = 25.0,
    idm: IdmParameters = TABLE_V,
) -> tuple[SceneVehicle, ...]:
    """Columns in every lane in which ``per_wave`` standing and ``per_wave`` flowing vehicles take turns.

    From the head: vehicles that flow off, then ``waves`` times a queue that stands bumper to bumper at IDM's smallest
    gap and a group that drives up to it at ``speed_mps``, in steady following. The ego is the last but one of the
    rightmost lane. All the others want to go 15 m/s.
    """
    steady = LENGTH_M + 1.1 * (idm.min_gap_m + idm.headway_s * speed_mps)
    queue = LENGTH_M + idm.min_gap_m
    approach = 5.0 * speed_mps
    speeds, spacings = [speed_mps] * 2, [0.0, steady]
    for _ in range(waves):
        speeds += [0.0] * per_wave + [speed_mps] * per_wave
        spacings += [steady] + [queue] * (per_wave - 1) + [approach] + [steady] * (per_wave - 1)
    column = [(-x, speed) for x, speed in zip(accumulate(spacings), speeds, strict=True)]
    ego_x, ego_speed = column[-2]
    others = [
        SceneVehicle(x - 7.0 * lane, lane, speed, 15.0)
        for lane in range(lanes)
        for k, (x, speed) in enumerate(column)
        if lane > 0 or k != len(column) - 2
    ]
    return (SceneVehicle(ego_x, 0, ego_speed, desired_speed_mps), *others)


def _at_least(lanes: int, needed: int, name: str) -> None:
    if lanes < needed:
        raise UserError(f"env.lanes={lanes}: env={name} needs {needed} lanes or more; give env.lanes={needed}.")
