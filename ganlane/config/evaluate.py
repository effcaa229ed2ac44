"""Root of ``ganlane evaluate``."""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.run import EPISODES, NAMES, GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig, all_traffics, chosen_traffics
from ganlane.parameters.checks import between, check, one_of
from ganlane.parameters.observation import MaskParameters, ObservationConfig
from ganlane.parameters.reward import RewardParameters

#: Families of episodes that can be driven for a table: to choose on, to report on.
STREAMS = ("report", "select")


@dataclass
class EvaluateConfig(RunConfig):
    """Agents x traffics, the same episodes for all of them.

    Attributes:
        agents: mobil, mobil_egoistic, keep_lane, random_legal, random; agent_idm and others that ship (agent_idm@1:
            its recipe trained with seed 1, agent_idm@all: with every seed there is); a checkpoint's path; the import
            path of a policy of your own. The normalised score needs mobil and random_legal.
        traffics: options of the group traffic, or the import path of a traffic model of your own.
        episodes: the episodes 0 to episodes - 1 of the seed and stream.
        num_envs: episodes driven side by side, at most.
        stream: select: the episodes kept for choosing among recipes, never for a reported figure.
        generator: weights of generated traffic.
        traffic_options: the traffics' keys.
    """

    agents: list[str] = field(default_factory=lambda: ["mobil", "keep_lane", "random_legal", "agent_idm"])
    traffics: list[str] = field(default_factory=lambda: ["idm", "idm_mobil", "gan", "gan_calibrated"])
    episodes: int = 100
    num_envs: int = 512
    stream: str = "report"
    env: EnvConfig = field(default_factory=EnvConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    generator: GeneratorFile = field(default_factory=GeneratorFile)
    traffic_options: dict[str, TrafficConfig] = field(default_factory=all_traffics)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, agents=NAMES, traffics=NAMES, episodes=EPISODES, num_envs=between(1, 65536))
        check(self, stream=one_of(STREAMS))
        check_reward(self.env, self.reward)
        self.chosen_traffics()

    def chosen_traffics(self) -> dict[str, TrafficConfig]:
        """The traffics asked for, by name: options of the group, or import paths of a user's own."""
        return chosen_traffics("traffics", self.traffics, self.traffic_options)
