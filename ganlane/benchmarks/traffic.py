"""``suite=traffic``: how fast each traffic model drives, and two Social-GANs written without this package's means.

The two stand under ``benchmarks/`` of a checkout: one loops over scenes as the original code does, one is padded and
decodes all steps. They predict and move, and do nothing else.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import Any

import torch

from ganlane import keys
from ganlane.benchmarks.case import COMPILED, EAGER, Case, Group, Labels, Row, Runner
from ganlane.benchmarks.systems import Scenario, build
from ganlane.benchmarks.tables import Table
from ganlane.benchmarks.traffic_findings import PADDED, SCENE_LOOP, SCENE_LOOP_ONCE, SYSTEM, ratios, speeds
from ganlane.benchmarks.traffic_tables import traffic_tables
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters
from ganlane.paths import PACKAGE

#: File under ``benchmarks/`` and further arguments of its ``start`` of each baseline.
BASELINES: dict[str, tuple[str, dict[str, Any]]] = {
    SCENE_LOOP: ("sgan_scene_loop", {}),
    SCENE_LOOP_ONCE: ("sgan_scene_loop", {"pool_every_step": False}),
    PADDED: ("sgan_padded", {}),
}
_FOLDER = PACKAGE.parent / "benchmarks"
_MISSING = "Not measured: the Social-GAN baselines; they stand under benchmarks/ of a checkout and are not installed."


@dataclass(frozen=True)
class TrafficOptions:
    """What to measure: the environment, the traffics by name, batches, modes, threads, and whether the baselines."""

    env: EnvConfig
    traffics: Mapping[str, TrafficConfig]
    batches: tuple[int, ...] = (512, 2048)
    modes: tuple[str, ...] = (EAGER, COMPILED)
    threads: tuple[int, ...] = (1, 2)
    peers: bool = True
    seed: int = 0


class TrafficSuite:
    """See :class:`ganlane.benchmarks.case.Suite`."""

    name = "traffic"
    memory = False

    def __init__(self, options: TrafficOptions) -> None:
        self.options, self.notes = options, list[str]()
        self.baselines = options.peers and (_FOLDER / "sgan_padded.py").is_file()
        if options.peers and not self.baselines:
            self.notes.append(_MISSING)

    def groups(self) -> list[Group]:
        """Per number of threads and batch all traffics in all modes and the baselines, in turns."""
        chosen = self.options
        return [self._group(threads, batch) for threads in chosen.threads for batch in chosen.batches]

    def _group(self, threads: int, batch: int) -> Group:
        chosen = self.options
        cases = [
            Case(
                self._labels(SYSTEM, name, mode, threads, batch),
                partial(start_traffic, self._scenario(config), mode, batch),
            )
            for name, config in chosen.traffics.items()
            for mode in chosen.modes
        ]
        for name in BASELINES if self.baselines else ():
            labels = self._labels(name, "Social-GAN", EAGER, threads, batch)
            cases.append(Case(labels, partial(start_baseline, name, batch, chosen.env.vehicles)))
        return Group(f"threads {threads}, batch {batch}", threads, cases)

    def _scenario(self, traffic: TrafficConfig) -> Scenario:
        env = self.options.env if traffic.label() == "replay" else replace(self.options.env, recycle=True)
        return Scenario(env, traffic, ObservationConfig(), RewardParameters(), self.options.seed)

    def _labels(self, system: str, traffic: str, mode: str, threads: int, batch: int) -> Labels:
        env = self.options.env
        return Labels(
            self.name, "speed", system, traffic, mode, "float32", "cpu", threads, env.vehicles, env.lanes, batch
        )

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``speeds``: the best row of each traffic; ``ratios``: of the generated ones to the baselines."""
        return {"speeds": speeds(rows), "ratios": ratios(rows)}

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """For a reader."""
        return traffic_tables(rows, findings)


def start_traffic(scenario: Scenario, mode: str, batch: int) -> Runner:
    """The environment without observation and reward, its ego keeping its lane; ended episodes start anew."""
    env = build(scenario, mode, "cpu", batch).base_env
    keep = torch.full((batch,), keys.KEEP)
    state = [env.reset()]

    def run(decisions: int) -> int:
        simulated = torch.zeros((), dtype=torch.int64)
        for _ in range(decisions):
            state[0].set(keys.ACTION, keep)
            before, state[0] = env.step_and_maybe_reset(state[0])
            simulated += (before["next", keys.STEP] - before[keys.STEP]).sum()
        return int(simulated)

    return run


def start_baseline(name: str, batch: int, vehicles: int) -> Runner:
    """One of :data:`BASELINES`, with weights drawn anew."""
    file, options = BASELINES[name]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return _module(file).start(batch, vehicles, **options)


def _module(name: str) -> ModuleType:
    """``benchmarks/NAME.py`` of the checkout, wherever the command runs."""
    full = f"benchmarks.{name}"
    if full not in sys.modules:
        spec = importlib.util.spec_from_file_location(full, _FOLDER / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        sys.modules[full] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[full])
    return sys.modules[full]
