"""Long runs without an ego: what a traffic does in minutes and over 5000 m, when nobody starts it anew.

Vehicles start as the simulator's own episodes do (Table II), on the paper's road, and drive until everybody is
expected to have covered 5000 m. Index 0 is not valid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ganlane import keys
from ganlane.evaluation.realism.counters import EventCounter, GuardMeter, watched
from ganlane.evaluation.realism.long_summary import DRIFT_S, GOAL_M, Course, measured, summary
from ganlane.evaluation.realism.simulation import Factory, step_traffic
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.random import absorb, episode_key
from ganlane.sim.road import Road
from ganlane.sim.spawn import TABLE_II, SpawnParameters, spawn
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule

#: Samples of one batch (times, rows, vehicles); bounds the memory.
_MOST_SAMPLES = 12_000_000
_MOST_ROWS = 64


@dataclass(frozen=True)
class LongRunParameters:
    """How much is driven, and by how many side by side.

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
        """Table II for so many vehicles and an empty place for the ego."""
        spread = self.spawn.spread_m * (self.vehicles + 1) / 9.0
        return replace(self.spawn, spread_m=max(self.spawn.spread_m, spread))


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
            course = drive_spawned(traffic, parameters, episodes, rows, events)
        part = measured(course, road)
        parts.append(part)
        km, episodes = km + part["vehicle_km"], episodes + rows
        if report is not None:
            report(km)
        if part["vehicle_km"] <= 0.0:
            break
    return summary(parts, events, meter, episodes, parameters.vehicles)


def _rows(parameters: LongRunParameters, km: float) -> int:
    """Episodes side by side for so many vehicle-km, if each vehicle covers a bit less than 5000 m."""
    expected = parameters.vehicles * min(4.8, 0.014 * parameters.most_s)
    steps = round(parameters.most_s / PHYSICS_STEP_S)
    most = max(1, min(_MOST_ROWS, _MOST_SAMPLES // (steps * parameters.vehicles)))
    return int(np.clip(np.ceil(km / expected), 1, most))


def spawned(traffic: TrafficModule, parameters: LongRunParameters, key: Tensor) -> Vehicles:
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
    """Length and width [N, M] in m of those whom :func:`drive_spawned` drives."""
    state = spawned(traffic, parameters, episode_key(traffic.stream, *_counters(parameters, first, rows).values()))
    return state.length[:, 1:].numpy(), state.width[:, 1:].numpy()


def drive_spawned(
    traffic: TrafficModule, parameters: LongRunParameters, first: int, rows: int, events: EventCounter
) -> Course:
    """One batch of ``rows`` episodes from number ``first`` on, from spawned starts; ``events`` counts."""
    counters = _counters(parameters, first, rows)
    key = episode_key(traffic.stream, *counters.values())
    state = spawned(traffic, parameters, key)
    memory = traffic.init_memory(state, torch.ones_like(state.valid), absorb(key, 0))
    course, start = [_snapshot(state)], state.x
    events.begin()
    for step in range(round(parameters.most_s / PHYSICS_STEP_S)):
        state, memory = step_traffic(traffic, state, memory, counters, step)
        events.count(state, step)
        course.append(_snapshot(state))
        # Once in ten seconds of driving a look at the distances costs nothing.
        if step % 100 == 99 and step * PHYSICS_STEP_S >= DRIFT_S[-1] and _arrived(state, start):
            break
    return Course(*(np.stack(values) for values in zip(*course)))


def _arrived(state: Vehicles, start: Tensor) -> bool:
    return bool(((state.x - start)[:, 1:].mean(1) >= GOAL_M).all())


def _snapshot(state: Vehicles) -> tuple[np.ndarray, ...]:
    return tuple(getattr(state, name)[:, 1:].numpy() for name in ("x", "y", "speed"))
