"""``ganlane benchmark``: what a suite fixes (its protocol), and what the command takes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from ganlane.errors import ParameterError
from ganlane.settings.commands import (
    Environments,
    Episodes,
    EvaluateConfig,
    Measured,
    Names,
    RunConfig,
)
from ganlane.settings.env import EnvConfig
from ganlane.settings.generator import shipped_generator
from ganlane.settings.observation import MaskParameters, ObservationConfig, RewardParameters
from ganlane.settings.record import DIFFERENT, Record, Rule, Text, between, plain
from ganlane.settings.traffic import traffics_of

#: Of the episodes, what ``quick=true`` drives.
QUICK_SHARE = 0.2
#: Settings that traffics had when a version was published, by version and name: where defaults have
#: changed since, it keeps them.
PUBLISHED: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "shift-v1": {"human": {"path": str(shipped_generator("human_1")), "lane_changes": 1.8}}
}
_PAIR = Rule(lambda names: len(names) == 2, "two drivers, [first, second]")


@dataclass(frozen=True)
class Suite(Record):
    """``suite``: the protocol of a benchmark. Whoever drives by the same one has the same hash.

    Attributes:
        version: its name; one that is published is never changed.
        stream: family of the episodes; benchmark: that of no training.
        baselines: drive beside random_legal (score 0) and mobil (score 100).
        agents: of a command that names none.
        scored: traffics that count in the score, with their episodes.
        shown: traffics that are reported beside them where they are at hand.
        pairs: which driver is compared with which, besides every agent with MOBIL and baselines.
        env: road, vehicles, first scenes, end of an episode.
        reward: section V.C.
    """

    group = "suite"

    version: Text = "mine"
    stream: Measured = "benchmark"
    baselines: list[Text] = field(default_factory=list)
    agents: Annotated[list[Text], DIFFERENT] = field(default_factory=lambda: ["agent_general"])
    scored: dict[str, Annotated[int, between(2, 10_000)]] = field(
        default_factory=lambda: {"idm_mobil": 100}
    )
    shown: dict[str, Episodes] = field(default_factory=dict)
    pairs: list[Annotated[list[Text], _PAIR]] = field(default_factory=list)
    env: EnvConfig = EnvConfig()
    reward: RewardParameters = RewardParameters()

    def __post_init__(self) -> None:
        super().__post_init__()
        twice = set(self.scored) & set(self.shown)
        if not self.scored or twice:
            raise ParameterError(
                "{scored}: expected at least one traffic, and none of those in {shown}."
            )
        self.traffics()

    def traffics(self) -> dict[str, Any]:
        """The settings of every traffic by its name, those of the score first."""
        by_name = traffics_of([*self.scored, *self.shown], "scored")
        for name, settings in PUBLISHED.get(self.version, {}).items():
            if name in by_name:
                by_name[name] = replace(by_name[name], **settings)
        return by_name

    def drivers(self) -> list[str]:
        """Who drives beside the agents."""
        return list(dict.fromkeys(["random_legal", "mobil", *self.baselines]))


def _changed(record: Record) -> dict[str, Any]:
    """The keys of a record that have not their defaults."""
    defaults = plain(type(record)())
    return {name: value for name, value in plain(record).items() if value != defaults[name]}


@dataclass(frozen=True)
class BenchmarkConfig(RunConfig):
    """Agents on a suite: scores, a table, a report with films.

    Attributes:
        agents: words without = mean the same: shipped agents, files, folders of trainings, import
            paths; agent_idm@all: every training of its recipe, as one entry.
        suite: the protocol; its keys may be changed, and the hash tells that they were.
        quick: a fifth of the episodes.
        observation: what a function of your own is given.
        mask: which actions it may choose.
        num_envs: episodes driven side by side, at most.
        cells: folder of what was driven; a pair of driver and traffic that is there is not driven
            again.
        films: failures of each entry that the report shows, at most.
    """

    agents: Names | None = None
    suite: Suite = field(default_factory=Suite)
    quick: bool = False
    observation: ObservationConfig = ObservationConfig()
    mask: MaskParameters = MaskParameters()
    num_envs: Environments = 256
    cells: str = "outputs/cells"
    films: Annotated[int, between(0, 10)] = 3

    def episodes_on(self, traffic: str) -> int:
        """Number of episodes on a traffic."""
        episodes = {**self.suite.scored, **self.suite.shown}[traffic]
        return max(2, round(episodes * QUICK_SHARE)) if self.quick else episodes

    def protocol(self) -> str:
        """Twelve digits of the SHA-256 of everything that the suite and the command fix.

        What has its default is left out, so a new key of a traffic changes no hash. That nobody
        changes what an option does is a matter of the tests.
        """
        suite = self.suite
        fixed: dict[str, Any] = {
            "version": suite.version,
            "stream": suite.stream,
            "scored": suite.scored,
            "shown": suite.shown,
            "env": _changed(suite.env),
            "reward": _changed(suite.reward),
            "seed": self.seed,
            "quick": self.quick,
        }
        # It changes how fast an episode is driven, not what happens in it.
        fixed["env"].pop("kernel", None)
        return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()[:12]

    def on(self, traffic: str) -> EvaluateConfig:
        """The same for one traffic, as ``ganlane evaluate`` takes it."""
        return EvaluateConfig(
            seed=self.seed,
            threads=self.threads,
            device=self.device,
            env=self.suite.env,
            observation=self.observation,
            mask=self.mask,
            reward=self.suite.reward,
            traffics={traffic: self.suite.traffics()[traffic]},
            episodes=self.episodes_on(traffic),
            num_envs=self.num_envs,
            stream=self.suite.stream,
        )
