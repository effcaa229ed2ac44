"""``suite=train``: decisions per second with learning, where the time goes, and stable-baselines3 beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch

from ganlane.agents import RainbowConfig
from ganlane.benchmarks.case import COMPILED, EAGER, Case, Group, Labels, Row
from ganlane.benchmarks.systems import Scenario
from ganlane.benchmarks.tables import Table
from ganlane.benchmarks.timing import Budget, torch_threads
from ganlane.benchmarks.train_findings import SYSTEM, best_rows, speeds
from ganlane.benchmarks.train_loop import Training, advance, filled_run, start_training
from ganlane.benchmarks.train_losses import compare_losses
from ganlane.benchmarks.train_peer import MISSING, baselines_case, baselines_version
from ganlane.benchmarks.train_shares import take_shares, totals
from ganlane.benchmarks.train_tables import train_tables
from ganlane.config.traffic import TrafficConfig

_NO_LOSS = "Not compared: TorchRL's distributional loss; the agent is not distributional."


@dataclass(frozen=True)
class TrainOptions:
    """What to measure.

    ``scenario`` is the road, observation and reward (its traffic is replaced by each of ``traffics``); ``agent``
    learns with ``stored`` transitions in its buffer. ``batches`` are numbers of environments side by side. ``budget``
    is that of the losses, which are measured beside the rows. ``peers``: whether stable-baselines3.
    """

    scenario: Scenario
    traffics: Mapping[str, TrafficConfig]
    agent: RainbowConfig
    batches: tuple[int, ...] = (256, 512, 1024)
    modes: tuple[str, ...] = (EAGER, COMPILED)
    threads: tuple[int, ...] = (1, 2)
    devices: tuple[str, ...] = ("cpu",)
    stored: int = 1_000_000
    budget: Budget = field(default_factory=Budget)
    peers: bool = True


class TrainSuite:
    """See :class:`ganlane.benchmarks.case.Suite`."""

    name = "train"
    memory = False

    def __init__(self, options: TrainOptions) -> None:
        self.options, self.notes = options, list[str]()
        self.has_peer = options.peers and baselines_version() is not None
        if options.peers and not self.has_peer:
            self.notes.append(MISSING)
        if not options.agent.distributional:
            self.notes.append(_NO_LOSS)

    def groups(self) -> list[Group]:
        """Per device, number of threads and batch all traffics in all modes, in turns with the peer."""
        chosen = self.options
        # A GPU's work does not depend on the host's threads.
        places = [("cpu", n) for n in chosen.threads] if "cpu" in chosen.devices else []
        places += [(device, chosen.threads[0]) for device in chosen.devices if device != "cpu"]
        return [self._group(*place, batch) for place in places for batch in chosen.batches]

    def _group(self, device: str, threads: int, batch: int) -> Group:
        chosen = self.options
        cases = [self._case(name, mode, device, threads, batch) for name in chosen.traffics for mode in chosen.modes]
        title = f"{device}, threads {threads}, {batch} environments"
        return Group(title, threads, cases, self._reference(threads) if self.has_peer else None)

    def _reference(self, threads: int) -> Case:
        chosen = self.options
        return baselines_case(chosen.scenario.env, chosen.agent, threads, chosen.scenario.seed)

    def _case(self, traffic: str, mode: str, device: str, threads: int, batch: int) -> Case:
        env = self.options.scenario.env
        labels = Labels(
            suite=self.name,
            part="speed",
            system=SYSTEM,
            traffic=traffic,
            mode=mode,
            dtype="float32",
            device=device,
            threads=threads,
            vehicles=env.vehicles,
            lanes=env.lanes,
            batch=batch,
        )
        return Case(labels, partial(start_training, self._training(traffic), mode, device, batch))

    def _training(self, traffic: str) -> Training:
        chosen = self.options
        scenario = replace(chosen.scenario, traffic=chosen.traffics[traffic])
        return Training(scenario, chosen.agent, chosen.stored)

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``speeds`` with the verdicts, ``shares`` of the time in the best row of each traffic, ``losses``."""
        agent = self.options.agent
        return {
            "speeds": speeds(rows, agent.batch_size, agent.decisions_per_update),
            "shares": [self._shares(row) for row in best_rows(rows)],
            "losses": self._losses(),
        }

    def _shares(self, row: Row) -> dict[str, Any]:
        """Once more as in ``row``, with timers, for about as long as all of its turns took."""
        if row["mode"] == COMPILED:
            torch.compiler.reset()
        decisions = max(3, math.ceil(row["repetitions"] * row["decisions"] / row["batch"]))
        with torch_threads(row["threads"]):
            run, env = filled_run(self._training(row["traffic"]), row["mode"], row["device"], row["batch"])
            advance(run, 3)  # compilation, caches
            shares, rate = take_shares(run, env, decisions, row["device"])
        labels = {key: row[key] for key in ("traffic", "device", "mode", "threads", "batch")}
        return {**labels, "decisions_per_s": rate, "shares": shares, "totals": totals(shares)}

    def _losses(self) -> list[dict[str, Any]]:
        chosen = self.options
        if not chosen.agent.distributional:
            return []
        return compare_losses(self._training(next(iter(chosen.traffics))), chosen.threads, chosen.budget)

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """For a reader."""
        return train_tables(rows, findings)
