"""The test scenarios: cut-in, stalled car, stop-and-go wave, blocked lane, and roads with lanes
that end: merge, on-ramp, weave, lane drop, off-ramp; m, m/s.

Functions of a few numbers that return the rows of a :class:`~ganlane.sim.scenes.FixedScene`, the
ego first. The numbers are those of the records in :mod:`ganlane.settings.env`.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate

from ganlane.errors import UserError
from ganlane.settings.driving import IdmParameters
from ganlane.sim.scenes import SceneVehicle, SceneVehicles

#: Length of every vehicle here, m: that of a car in SpawnParameters.
LENGTH_M = 4.5
#: Desired speed of a broken-down vehicle; IDM requires more than 0.
STALLED_MPS = 0.001
#: A broken-down car is this far right of its lane's centre. Off-centre vehicles start no lane
#: change, so MOBIL's politeness does not make it change lanes to let others pass.
ASKEW_M = 0.6


def stalled(x_m: float, lane: int, lane_width_m: float) -> SceneVehicle:
    """A vehicle that has broken down in ``lane``."""
    return SceneVehicle(x_m, y_m=lane * lane_width_m - ASKEW_M, desired_speed_mps=STALLED_MPS)


def cut_in(
    gap_m: float,
    speed_mps: float,
    cutter_speed_mps: float,
    lanes: int,
    desired_speed_mps: float,
) -> SceneVehicles:
    """A slower vehicle one lane to the left, ``gap_m`` ahead of the ego's bumper, moves into its
    lane at once.

    There are a leader 80 m ahead of the ego, a follower 35 m behind it, a vehicle behind the one
    that cuts in, and (on three lanes) one on the ego's right, so that braking is the obvious
    reaction.
    """
    _needs_two(lanes, "cut_in")
    # The ego's lane is next to the leftmost, from which the other vehicle comes.
    lane = lanes - 2
    cutter = SceneVehicle(
        gap_m + LENGTH_M,
        lane + 1,
        cutter_speed_mps,
        cutter_speed_mps,
        target_lane=lane,
    )
    cars = [
        SceneVehicle(0.0, lane, speed_mps, desired_speed_mps),
        cutter,
        SceneVehicle(80.0, lane, speed_mps, 22.0),
        SceneVehicle(-35.0, lane, speed_mps, 22.0),
        SceneVehicle(-40.0, lane + 1, speed_mps, 24.0),
    ]

    # On two lanes the ego is in the rightmost.
    if lane > 0:
        cars.append(SceneVehicle(-8.0, lane - 1, speed_mps, speed_mps))
    return tuple(cars)


def stalled_car(
    distance_m: float,
    speed_mps: float,
    spacing_m: float,
    lanes: int,
    desired_speed_mps: float,
    lane_width_m: float,
) -> SceneVehicles:
    """A broken-down vehicle ``distance_m`` ahead in the ego's lane, the rightmost.

    A vehicle follows the ego, and five vehicles ``spacing_m`` apart pass in the next lane, if there
    is one.
    """
    beside = () if lanes == 1 else _column(1, 5, 0.5 * spacing_m, spacing_m, speed_mps, 22.0)
    return (
        SceneVehicle(0.0, 0, speed_mps, desired_speed_mps),
        stalled(distance_m, 0, lane_width_m),
        SceneVehicle(-50.0, 0, speed_mps, 22.0),
        *beside,
    )


def blocked_lane(
    distance_m: float,
    standing: int,
    speed_mps: float,
    spacing_m: float,
    lanes: int,
    desired_speed_mps: float,
    lane_width_m: float,
) -> SceneVehicles:
    """The rightmost lane is closed by ``standing`` vehicles in a row, from ``distance_m`` on; the
    others are open.

    In each open lane drive six vehicles, ``spacing_m`` apart: the ego has to find a gap.
    """
    _needs_two(lanes, "blocked_lane")
    cars = [SceneVehicle(0.0, 0, speed_mps, desired_speed_mps)]
    for number in range(standing):
        # 1.5 m from bumper to bumper: no gap to slip into.
        cars.append(stalled(distance_m + (LENGTH_M + 1.5) * number, 0, lane_width_m))

    # One behind the ego, and the traffic of the open lanes.
    cars.append(SceneVehicle(-50.0, 0, speed_mps, 20.0))
    for lane in range(1, lanes):
        cars += _column(lane, 6, 1.3 * spacing_m, spacing_m, speed_mps, 20.0)
    return tuple(cars)


def _column(
    lane: int,
    vehicles: int,
    first_m: float,
    spacing_m: float,
    speed_mps: float,
    desired_speed_mps: float | None = None,
) -> SceneVehicles:
    """Vehicles in one lane, from ``first_m`` backwards.

    Without a desired speed they would like to be in turn as fast, 10 % and 20 % faster.
    """
    cars = []
    for k in range(vehicles):
        desired_mps = desired_speed_mps or speed_mps * (1.0 + 0.1 * (k % 3))
        cars.append(SceneVehicle(first_m - spacing_m * k, lane, speed_mps, desired_mps))
    return tuple(cars)


def stop_and_go(
    waves: int,
    per_wave: int,
    speed_mps: float,
    lanes: int,
    desired_speed_mps: float,
    idm: IdmParameters,
) -> SceneVehicles:
    """Columns in every lane, of alternately ``per_wave`` stopped and ``per_wave`` moving vehicles.

    From the head: two moving vehicles, then ``waves`` times a stopped queue at IDM's minimum gap
    and a group that approaches it at ``speed_mps`` in steady following. The ego is the last but one
    of the rightmost lane. The desired speed of the others is 15 m/s.
    """
    # Centre to centre; a tenth more than IDM's own gap, since speeds are jittered.
    steady = LENGTH_M + 1.1 * (idm.min_gap_m + idm.headway_s * speed_mps)
    queue = LENGTH_M + idm.min_gap_m
    # Five seconds away, so that the group has time to brake.
    approach = 5.0 * speed_mps

    # Of every vehicle: its speed, and its distance to the one ahead of it.
    speeds = [speed_mps] * 2
    spacings = [0.0, steady]
    for _ in range(waves):
        speeds += [0.0] * per_wave + [speed_mps] * per_wave
        spacings += [steady] + [queue] * (per_wave - 1)
        spacings += [approach] + [steady] * (per_wave - 1)

    # From the head of the column backwards.
    column = [(-x, speed) for x, speed in zip(accumulate(spacings), speeds, strict=True)]

    # The last but one: somebody behind it can run into it.
    ego_x, ego_speed = column[-2]
    cars = [SceneVehicle(ego_x, 0, ego_speed, desired_speed_mps)]
    for lane in range(lanes):
        for place, (x, speed) in enumerate(column):
            if lane > 0 or place != len(column) - 2:
                # The columns of neighbouring lanes are 7 m apart, so that nobody stands level.
                cars.append(SceneVehicle(x - 7.0 * lane, lane, speed, 15.0))
    return tuple(cars)


def merge(
    ego_speed_mps: float, speed_mps: float, spacing_m: float, lanes: int, desired_speed_mps: float
) -> SceneVehicles:
    """The ego alone on the rightmost lane, an on-ramp; ten vehicles ``spacing_m`` apart in each of
    the others, a third of them ahead of it.
    """
    _needs_two(lanes, "merge")
    ego = SceneVehicle(0.0, 0, ego_speed_mps, desired_speed_mps)
    return (ego, *_around(ego, range(1, lanes), 10, 3.0, spacing_m, speed_mps))


def on_ramp(
    ramp_speed_mps: float,
    ramp_spacing_m: float,
    speed_mps: float,
    spacing_m: float,
    lanes: int,
    desired_speed_mps: float,
) -> SceneVehicles:
    """Six vehicles ``ramp_spacing_m`` apart on the rightmost lane, an on-ramp, three of them ahead
    of the ego in the lane beside it; seven ``spacing_m`` apart in every other lane, and six in its
    own.
    """
    _needs_two(lanes, "on_ramp")
    ego = SceneVehicle(0.0, 1, speed_mps, desired_speed_mps)
    ramp = _column(0, 6, 2.5 * ramp_spacing_m, ramp_spacing_m, ramp_speed_mps)
    return (ego, *ramp, *_around(ego, range(1, lanes), 7, 2.0, spacing_m, speed_mps))


def lane_drop(
    speed_mps: float, spacing_m: float, lanes: int, desired_speed_mps: float
) -> SceneVehicles:
    """The ego in the leftmost lane, which ends; seven vehicles ``spacing_m`` apart in every other
    lane, and six in its own.
    """
    _needs_two(lanes, "lane_drop")
    ego = SceneVehicle(0.0, lanes - 1, speed_mps, desired_speed_mps)
    return (ego, *_around(ego, range(lanes), 7, 2.0, spacing_m, speed_mps))


def exit(
    speed_mps: float, faster_mps: float, spacing_m: float, lanes: int, desired_speed_mps: float
) -> SceneVehicles:
    """The ego in the leftmost lane; eight vehicles ``spacing_m`` apart in every other lane and
    seven in its own, but none in the rightmost, the exit lane.

    Each lane is ``faster_mps`` faster than the one on its right.
    """
    _needs_two(lanes, "exit")
    ego_speed = speed_mps + faster_mps * (lanes - 2)
    ego = SceneVehicle(0.0, lanes - 1, ego_speed, desired_speed_mps)
    return (ego, *_around(ego, range(1, lanes), 8, 3.0, spacing_m, speed_mps, faster_mps))


def _around(
    ego: SceneVehicle,
    lanes: Iterable[int],
    vehicles: int,
    ahead: float,
    spacing_m: float,
    speed_mps: float,
    faster_mps: float = 0.0,
) -> SceneVehicles:
    """A :func:`_column` in each of the ``lanes``, the first one ``ahead`` spacings before the ego.

    Neighbouring lanes are staggered by half of the spacing. In its own lane the ego has the place
    of one of them. Each lane is ``faster_mps`` faster than the one on its right, from
    ``speed_mps`` in lane 1.
    """
    assert ego.lane is not None
    cars: list[SceneVehicle] = []
    for lane in lanes:
        first_m = (ahead + 0.5 * (abs(lane - ego.lane) % 2)) * spacing_m
        speed = speed_mps + faster_mps * (lane - 1)
        stream = _column(lane, vehicles, first_m, spacing_m, speed)
        # The ego is at x = 0.
        cars += [car for car in stream if car.x_m or lane != ego.lane]
    return tuple(cars)


def _needs_two(lanes: int, name: str) -> None:
    if lanes < 2:
        raise UserError(f"env.lanes={lanes}: env={name} needs 2 lanes or more; give env.lanes=2.")
