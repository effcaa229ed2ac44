"""Root of ``ganlane record``."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.run import EPISODES, GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.parameters.checks import Rule, between, check, one_of, optional, text
from ganlane.parameters.observation import MaskParameters, ObservationConfig
from ganlane.parameters.reward import RewardParameters

_DATASET = Rule(
    lambda name: isinstance(name, str) and re.fullmatch(r"(\w[\w-]*/)*\w[\w-]*-v\d+", name, re.ASCII) is not None,
    "a name such as highway/mobil-v0, its parts of letters, digits, - and _",
)


@dataclass
class RecordConfig(RunConfig):
    """A driver's episodes as an offline dataset.

    Attributes:
        driver: agent=NAME says the same: a name, path or import path as in ganlane evaluate.
        episodes: the episodes 0 to episodes - 1 of the seed and stream.
        num_envs: episodes driven side by side, at most.
        stream: train, select or report (the episodes of ganlane evaluate).
        out: folder of the datasets, Minari's MINARI_DATASETS_PATH; null: the run folder.
        dataset: the dataset's name; null: ganlane/TRAFFIC/DRIVER-v0.
        generator: weights of generated traffic.
    """

    driver: str = "mobil"
    episodes: int = 100
    num_envs: int = 64
    stream: str = "train"
    out: str | None = None
    dataset: str | None = None
    env: EnvConfig = field(default_factory=EnvConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    generator: GeneratorFile = field(default_factory=GeneratorFile)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, episodes=EPISODES, num_envs=between(1, 65536), stream=one_of(("train", "select", "report")))
        check(self, out=optional(text()), dataset=optional(_DATASET))
        check_reward(self.env, self.reward)

    def dataset_name(self) -> str:
        """The dataset's name, made from traffic and driver where none is given."""
        parts = (re.sub(r"[^A-Za-z0-9_]+", "_", part).strip("_") for part in (self.traffic.label(), self.driver))
        return self.dataset or f"ganlane/{'/'.join(parts)}-v0"
