"""The numbers of long runs: rates with exact intervals, drifts, quantiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ganlane.data import lane_changes_of_arrays
from ganlane.evaluation.counts import poisson_interval
from ganlane.evaluation.realism.counters import EventCounter, GuardMeter
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.road import Road

#: Times at which the speeds are looked at, s; and where, m.
DRIFT_S = (10.0, 60.0, 150.0, 300.0)
GOAL_M = 5000.0
#: Levels of the acceleration's quantiles.
QUANTILES = (0.05, 0.95)
#: Events that are told as numbers.
_EVENTS = ("off_road", "standstills_in_free_flow")


class Course(NamedTuple):
    """Positions and speeds [T, N, M] of the vehicles of a batch (no ego), m and m/s."""

    x: np.ndarray
    y: np.ndarray
    speed: np.ndarray

    @property
    def driven_m(self) -> np.ndarray:
        """[T, N, M] from the start."""
        return self.x - self.x[:1]


def measured(course: Course, road: Road) -> dict[str, Any]:
    """What one batch adds to the numbers."""
    flat = course.y.reshape(len(course.y), -1)
    changes, _ = lane_changes_of_arrays(flat, float(road.lane_width_m))
    second = round(1.0 / PHYSICS_STEP_S)
    x = course.x.astype(np.float64)
    # The same filter as for the recordings; one sample a second is plenty.
    bend = x[2 * second :: second] - 2.0 * x[second:-second:second] + x[: -2 * second : second]
    rows = x.shape[1]
    return {
        "vehicle_km": float(course.driven_m[-1].sum(dtype=np.float64)) / 1000.0,
        "lane_changes": len(changes),
        "durations": changes.duration_s[changes.complete],
        "acceleration": bend.ravel(),
        "drift": [[_at_time(course, row, seconds) for row in range(rows)] for seconds in DRIFT_S],
        "at_goal": [_at_goal(course, row) for row in range(rows)],
    }


def _speeds(course: Course, row: int, time: int) -> tuple[float, float]:
    """Mean and standard deviation of an episode's speeds, m/s."""
    speed = course.speed[time, row].astype(np.float64)
    return float(speed.mean()), float(speed.std(ddof=1)) if len(speed) > 1 else 0.0


def _at_time(course: Course, row: int, seconds: float) -> tuple[float, float] | None:
    time = round(seconds / PHYSICS_STEP_S)
    return _speeds(course, row, time) if time < len(course.x) else None


def _at_goal(course: Course, row: int) -> tuple[float, float, float] | None:
    """Speeds when the episode's vehicles have covered 5000 m on average, and the time, s; None if they never do."""
    there = np.flatnonzero(course.driven_m[:, row].mean(-1) >= GOAL_M)
    return (*_speeds(course, row, there[0]), there[0] * PHYSICS_STEP_S) if len(there) else None


def summary(
    parts: list[dict[str, Any]],
    events: EventCounter,
    meter: GuardMeter,
    episodes: int,
    vehicles: int,
) -> dict[str, Any]:
    """The numbers of a long run; rates are per vehicle-km, with exact 95 % intervals, None where nobody moved."""
    km = sum(part["vehicle_km"] for part in parts)
    changes = sum(part["lane_changes"] for part in parts)
    durations = np.concatenate([part["durations"] for part in parts])
    acceleration = np.concatenate([part["acceleration"] for part in parts])
    return {
        "vehicles": vehicles,
        "episodes": episodes,
        "vehicle_km": km,
        "lane_changes": changes,
        "lane_change_duration_mean_s": float(durations.mean()) if len(durations) else None,
        "overlaps": events.overlaps,
        **rates(changes, events.overlaps, km),
        "off_road": events.off_road,
        "standstills_in_free_flow": events.standstills,
        "acceleration_quantiles": {f"{level:g}": float(np.quantile(acceleration, level)) for level in QUANTILES},
        "speeds": _drift(parts),
        "guard_share": meter.share,
    }


def rates(lane_changes: int, overlaps: int, km: float) -> dict[str, Any]:
    """Both counts per vehicle-km and per 1000 of them, with exact 95 % intervals; None where nobody moved."""
    numbers: dict[str, Any] = {}
    for name, events, scale in (
        ("lane_changes_per_vehicle_km", lane_changes, 1.0),
        ("overlaps_per_1000_vehicle_km", overlaps, 1000.0),
    ):
        count = poisson_interval(events)
        numbers[name] = scale * count.value / km if km > 0.0 else None
        numbers[f"{name}_ci"] = [scale * bound / km for bound in count.interval or ()] if km > 0.0 else None
    return numbers


def _drift(parts: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | int | None]]:
    """Mean speed and spread after each of :data:`DRIFT_S`, and where :data:`GOAL_M` were covered."""
    drift = {
        f"{seconds:g} s": _mean([row for part in parts for row in part["drift"][index]])
        for index, seconds in enumerate(DRIFT_S)
    }
    return drift | {f"{GOAL_M:g} m": _mean([row for part in parts for row in part["at_goal"]])}


def _mean(rows: list[tuple[float, ...] | None]) -> dict[str, float | int | None]:
    """Means over the episodes that got so far; and how many did."""
    known = [row for row in rows if row is not None]
    names = ("mean_speed_mps", "spread_mps", "after_s")
    means = {name: float(np.mean(values)) for name, values in zip(names, zip(*known))} if known else {}
    return {"mean_speed_mps": None, "spread_mps": None, **means, "episodes": len(known)}


def totals(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Lane changes, overlaps and the like over all long runs, with exact 95 % intervals; None without any."""
    sums = {key: sum(run[key] for run in runs) for key in ("lane_changes", "overlaps", "vehicle_km", *_EVENTS)}
    events = {name: sums[name] if runs else None for name in _EVENTS}
    return {**events, **rates(sums["lane_changes"], sums["overlaps"], sums["vehicle_km"])}
