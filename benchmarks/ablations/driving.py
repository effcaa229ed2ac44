"""Driving a variant without an ego, and what is counted meanwhile."""

from __future__ import annotations

import time
from statistics import median
from typing import Any

from benchmarks.ablations.variants import Variant
from ganlane.realism.long_runs import (
    EventCounter,
    GuardMeter,
    LongRunParameters,
    Trajectories,
    batch_statistics,
    drive_spawned,
    summary,
    watched,
)
from ganlane.sim.road import Road
from ganlane.traffic import TrafficModule


class StepClock:
    """CPU seconds of every call of a traffic, all threads."""

    def __init__(self, traffic: TrafficModule) -> None:
        self.seconds, self._begun = list[float](), 0.0
        traffic.register_forward_pre_hook(self._begin)
        traffic.register_forward_hook(self._end)

    def _begin(self, *_: Any) -> None:
        self._begun = time.process_time()

    def _end(self, *_: Any) -> None:
        self.seconds.append(time.process_time() - self._begun)


def drive(variant: Variant, parameters: LongRunParameters, batch: int) -> dict[str, Any]:
    """Drive ``batch`` episodes at a time until the wanted vehicle-km are covered.

    Returns:
        The numbers of a long run, mean speed and its spread at the end, physics steps per CPU second.
    """
    events, meter, parts, ends, seconds = EventCounter(Road()), GuardMeter(), [], [], list[float]()
    while sum(part["vehicle_km"] for part in parts) < parameters.vehicle_km:
        traffic = variant.make()
        clock = StepClock(traffic)
        with watched(traffic, meter):
            course = drive_spawned(traffic, parameters, batch * len(parts), batch, events)
        parts.append(batch_statistics(course, Road()))
        ends.append(at_the_end(course))
        seconds += clock.seconds
        if parts[-1]["vehicle_km"] <= 0.0:
            break
    numbers = summary(parts, events, meter, batch * len(parts), parameters.vehicles)
    mean, spread = (sum(values) / len(values) for values in zip(*ends))
    return {
        **numbers,
        "mean_speed_mps": mean,
        "spread_mps": spread,
        "physics_steps_per_cpu_s": batch / median(seconds),
    }


def at_the_end(course: Trajectories) -> tuple[float, float]:
    """Mean speed, and standard deviation within an episode, at the end of all episodes, m/s."""
    last = course.speed[-1].astype("float64")
    return float(last.mean()), float(last.std(axis=-1, ddof=1).mean())
