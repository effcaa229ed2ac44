"""Long runs without an ego: what a traffic does over minutes and 5000 m.

Vehicles start as the simulator's own episodes do (Table II), on the paper's road, and drive until everybody is
expected to have covered 5000 m. Index 0, the ego's, is not valid. Results are rates with exact intervals, speeds over
time, and quantiles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ganlane import keys
from ganlane.data import lane_changes_of_arrays
from ganlane.evaluation.statistics import poisson_interval
from ganlane.keys import PHYSICS_STEP_S
from ganlane.realism.counters import EventCounter, GuardMeter, watched
from ganlane.realism.replay_starts import Factory, step_traffic
from ganlane.sim.random import absorb, episode_key
from ganlane.sim.road import Road
from ganlane.sim.spawn import TABLE_II, SpawnParameters, spawn
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule

#: Times at which speeds are summarised, s; and the distance of the goal, m.
DRIFT_S = (10.0, 60.0, 150.0, 300.0)
GOAL_M = 5000.0
#: Levels of the acceleration's quantiles.
QUANTILES = (0.05, 0.95)
#: Events that are reported as plain counts.
_EVENTS = ("off_road", "standstills_in_free_flow")
#: Samples of one batch (times, rows, vehicles); bounds the memory.
_MOST_SAMPLES = 12_000_000
_MOST_ROWS = 64


@dataclass(frozen=True)
class LongRunParameters:
    """Length and size of a long run.

    Attributes:
        vehicles: of an episode, none of them an ego.
        vehicle_km: at least so many are driven.
        most_s: no episode lasts longer, s; it ends when its vehicles have covered 5000 m on average and 5 minutes
            have passed.
        seed: of the random numbers.
        spawn: Table II; the spread grows with the vehicles at the paper's density.
    """

    vehicles: int = 9
    vehicle_km: float = 3000.0
    most_s: float = 600.0
    seed: int = 0
    spawn: SpawnParameters = TABLE_II

    def start(self) -> SpawnParameters:
        """Table II for ``vehicles`` and an empty place for the ego."""
        spread = self.spawn.spread_m * (self.vehicles + 1) / 9.0
        return replace(self.spawn, spread_m=max(self.spawn.spread_m, spread))


class Trajectories(NamedTuple):
    """Positions and speeds [T, N, M] of the vehicles of a batch (no ego), m and m/s."""

    x: np.ndarray
    y: np.ndarray
    speed: np.ndarray

    @property
    def driven_m(self) -> np.ndarray:
        """[T, N, M] from the start."""
        return self.x - self.x[:1]


def long_run(
    make: Factory, road: Road, parameters: LongRunParameters, report: Callable[[float], None] | None = None
) -> dict[str, Any]:
    """Drive ``parameters.vehicle_km`` and count; the numbers as :func:`summary` gives them.

    Args:
        make: the traffic.
        road: of all episodes.
        parameters: how much.
        report: called with the vehicle-km driven so far.
    """
    traffic, meter, events, parts = make(road), GuardMeter(), EventCounter(road), []
    km, episodes = 0.0, 0
    while km < parameters.vehicle_km:
        rows = _rows(parameters, parameters.vehicle_km - km)
        with watched(traffic, meter):
            trajectories = drive_spawned(traffic, parameters, episodes, rows, events)
        part = batch_statistics(trajectories, road)
        parts.append(part)
        km, episodes = km + part["vehicle_km"], episodes + rows
        if report is not None:
            report(km)
        if part["vehicle_km"] <= 0.0:
            break
    return summary(parts, events, meter, episodes, parameters.vehicles)


def _rows(parameters: LongRunParameters, km: float) -> int:
    """Number of parallel episodes for ``km`` vehicle-km, if each vehicle covers a little less than 5000 m."""
    expected = parameters.vehicles * min(4.8, 0.014 * parameters.most_s)
    steps = round(parameters.most_s / PHYSICS_STEP_S)
    most = max(1, min(_MOST_ROWS, _MOST_SAMPLES // (steps * parameters.vehicles)))
    return int(np.clip(np.ceil(km / expected), 1, most))


def spawned_vehicles(traffic: TrafficModule, parameters: LongRunParameters, key: Tensor) -> Vehicles:
    """The vehicles [N, M + 1] at the start of the episodes ``key`` [N]; index 0, an ego's, is not valid."""
    lanes, width, seen = traffic.road.lanes, traffic.road.lane_width_m, int(traffic.visibility)
    assert not isinstance(lanes, Tensor)
    assert not isinstance(width, Tensor)
    start = parameters.start()
    vehicles = spawn(key, parameters.vehicles + 1, lanes, float(width), start, others_visibility=seen)
    index = torch.arange(parameters.vehicles + 1)
    return vehicles.with_(valid=vehicles.valid & (index > 0))


def _counters(parameters: LongRunParameters, first: int, rows: int) -> dict[str, Tensor]:
    """Seed and episode [N] of ``rows`` episodes from number ``first`` on."""
    return {keys.SEED: torch.full((rows,), parameters.seed), keys.EPISODE: first + torch.arange(rows)}


def sizes(traffic: TrafficModule, parameters: LongRunParameters, first: int, rows: int) -> tuple[np.ndarray, ...]:
    """Length and width [N, M] in m of the vehicles that :func:`drive_spawned` drives."""
    state = spawned_vehicles(
        traffic, parameters, episode_key(traffic.stream, *_counters(parameters, first, rows).values())
    )
    return state.length[:, 1:].numpy(), state.width[:, 1:].numpy()


def drive_spawned(
    traffic: TrafficModule, parameters: LongRunParameters, first: int, rows: int, events: EventCounter
) -> Trajectories:
    """One batch of ``rows`` episodes from number ``first`` on, from spawned starts; ``events`` counts."""
    counters = _counters(parameters, first, rows)
    key = episode_key(traffic.stream, *counters.values())
    state = spawned_vehicles(traffic, parameters, key)
    memory = traffic.init_memory(state, torch.ones_like(state.valid), absorb(key, 0))
    trajectories, start = [_snapshot(state)], state.x
    events.begin()
    for step in range(round(parameters.most_s / PHYSICS_STEP_S)):
        state, memory = step_traffic(traffic, state, memory, counters, step)
        events.count(state, step)
        trajectories.append(_snapshot(state))
        # Distances are tested once in ten seconds of driving: cheap, and exact enough.
        if step % 100 == 99 and step * PHYSICS_STEP_S >= DRIFT_S[-1] and _goal_reached(state, start):
            break
    return Trajectories(*(np.stack(values) for values in zip(*trajectories)))


def _goal_reached(state: Vehicles, start: Tensor) -> bool:
    return bool(((state.x - start)[:, 1:].mean(1) >= GOAL_M).all())


def _snapshot(state: Vehicles) -> tuple[np.ndarray, ...]:
    return tuple(getattr(state, name)[:, 1:].numpy() for name in ("x", "y", "speed"))


def batch_statistics(trajectories: Trajectories, road: Road) -> dict[str, Any]:
    """Counts, samples and speeds of one batch."""
    flat = trajectories.y.reshape(len(trajectories.y), -1)
    changes, _ = lane_changes_of_arrays(flat, float(road.lane_width_m))
    second = round(1.0 / PHYSICS_STEP_S)
    x = trajectories.x.astype(np.float64)
    # The same filter as for recordings; one sample a second is enough.
    bend = x[2 * second :: second] - 2.0 * x[second:-second:second] + x[: -2 * second : second]
    rows = x.shape[1]
    return {
        "vehicle_km": float(trajectories.driven_m[-1].sum(dtype=np.float64)) / 1000.0,
        "lane_changes": len(changes),
        "durations": changes.duration_s[changes.complete],
        "acceleration": bend.ravel(),
        "drift": [[_at_time(trajectories, row, seconds) for row in range(rows)] for seconds in DRIFT_S],
        "at_goal": [_at_goal(trajectories, row) for row in range(rows)],
    }


def _speeds(trajectories: Trajectories, row: int, time: int) -> tuple[float, float]:
    """Mean and standard deviation of an episode's speeds, m/s."""
    speed = trajectories.speed[time, row].astype(np.float64)
    return float(speed.mean()), float(speed.std(ddof=1)) if len(speed) > 1 else 0.0


def _at_time(trajectories: Trajectories, row: int, seconds: float) -> tuple[float, float] | None:
    time = round(seconds / PHYSICS_STEP_S)
    return _speeds(trajectories, row, time) if time < len(trajectories.x) else None


def _at_goal(trajectories: Trajectories, row: int) -> tuple[float, float, float] | None:
    """Speeds when the episode's vehicles have covered 5000 m on average, and the time, s; None if they never do."""
    there = np.flatnonzero(trajectories.driven_m[:, row].mean(-1) >= GOAL_M)
    return (*_speeds(trajectories, row, there[0]), there[0] * PHYSICS_STEP_S) if len(there) else None


def summary(
    parts: list[dict[str, Any]],
    events: EventCounter,
    meter: GuardMeter,
    episodes: int,
    vehicles: int,
) -> dict[str, Any]:
    """The numbers of a long run; rates are per vehicle-km, with exact 95 % intervals, None where no vehicle moved."""
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
        "speeds": _speeds_over_time(parts),
        "guard_share": meter.share,
    }


def rates(lane_changes: int, overlaps: int, km: float) -> dict[str, Any]:
    """Both counts per vehicle-km and per 1000 of them, with exact 95 % intervals; None where no vehicle moved."""
    numbers: dict[str, Any] = {}
    for name, events, scale in (
        ("lane_changes_per_vehicle_km", lane_changes, 1.0),
        ("overlaps_per_1000_vehicle_km", overlaps, 1000.0),
    ):
        count = poisson_interval(events)
        numbers[name] = scale * count.value / km if km > 0.0 else None
        numbers[f"{name}_ci"] = [scale * bound / km for bound in count.interval or ()] if km > 0.0 else None
    return numbers


def _speeds_over_time(parts: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | int | None]]:
    """Mean speed and spread after each of :data:`DRIFT_S` and after :data:`GOAL_M`."""
    drift = {
        f"{seconds:g} s": _mean([row for part in parts for row in part["drift"][index]])
        for index, seconds in enumerate(DRIFT_S)
    }
    return drift | {f"{GOAL_M:g} m": _mean([row for part in parts for row in part["at_goal"]])}


def _mean(rows: list[tuple[float, ...] | None]) -> dict[str, float | int | None]:
    """Means over the episodes that lasted so long, and their number."""
    known = [row for row in rows if row is not None]
    names = ("mean_speed_mps", "spread_mps", "after_s")
    means = {name: float(np.mean(values)) for name, values in zip(names, zip(*known))} if known else {}
    return {"mean_speed_mps": None, "spread_mps": None, **means, "episodes": len(known)}


def totals(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Event counts and rates over all long runs, with exact 95 % intervals; None without any."""
    sums = {key: sum(run[key] for run in runs) for key in ("lane_changes", "overlaps", "vehicle_km", *_EVENTS)}
    events = {name: sums[name] if runs else None for name in _EVENTS}
    return {**events, **rates(sums["lane_changes"], sums["overlaps"], sums["vehicle_km"])}
