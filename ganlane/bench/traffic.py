"""``suite=traffic``: how fast each traffic model drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from ganlane import keys
from ganlane.bench.measure import Case, Group, Row, Runner, Suite, best_rows, speed_table
from ganlane.bench.systems import EnvironmentRunner, Scenario
from ganlane.evaluation.table import Table
from ganlane.parameters.observation import ObservationConfig, RewardParameters

SYSTEM = "ganlane traffic"
_HEADINGS = (
    *("system", "traffic", "mode", "threads", "batch"),
    *("physics steps/s", "vehicle-steps/s", "physics steps/CPU-s", "spread"),
)


class TrafficSuite(Suite):
    """Per number of threads and batch all traffics in all modes, in turns."""

    name = "traffic"

    def groups(self) -> list[Group]:
        """One group per number of threads and batch."""
        return [
            Group(f"threads {threads}, batch {batch}", threads, self.cases(threads, batch))
            for threads in self.config.threads
            for batch in self.config.traffic_batches
        ]

    def cases(self, threads: int, batch: int) -> list[Case]:
        """The cases of a group; the road is kept full, except in replayed traffic."""
        cases = []
        for name, traffic in self.config.chosen_traffics().items():
            env = self.config.env if traffic.label() == "replay" else replace(self.config.env, recycle=True)
            scenario = Scenario(env, traffic, ObservationConfig(), RewardParameters(), self.config.seed)
            for mode in self.config.modes:
                labels = self.labels(SYSTEM, name, mode, threads, batch)
                cases.append(Case(labels, partial(start_traffic, scenario, mode, batch)))
        return cases

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``speeds``: the best row of each traffic."""
        return {"speeds": best_rows(rows, "physics_steps_per_s")}

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """All rows."""
        return [speed_table("Speed of the traffic", rows, _HEADINGS, names=3)]


def start_traffic(scenario: Scenario, mode: str, batch: int) -> Runner:
    """The environment without observation and reward, its ego keeping its lane; ended episodes start anew."""
    env = scenario.build(mode, "cpu", batch).base_env
    return EnvironmentRunner(env, torch.full((1, batch), keys.KEEP))
