"""Root of ``ganlane reproduce``."""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.run import NAMES, GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig, all_traffics, chosen_traffics
from ganlane.parameters.checks import Rule, between, check, every, one_of
from ganlane.parameters.observation import MaskParameters, ObservationConfig
from ganlane.parameters.reward import RewardParameters

SOURCES = ("shipped", "scratch")
#: Recipes of which there are several trainings, and the masks behind which each agent drives.
_TRAINED = ("agent_idm@all", "agent_gan@all", "agent_general")
_MASKS = ("none", "legal", "safe")


def _drivers() -> list[str]:
    behind = [f"{agent}+{mask}" for agent in _TRAINED for mask in _MASKS]
    return ["random_legal", "keep_lane", "mobil", "mobil_egoistic", *behind]


def _traffics() -> list[str]:
    return [name for name in all_traffics() if name != "mixed"]


def _fewer() -> dict[str, int]:
    return {"gan": 200, "gan_calibrated": 200, "replay": 200, "sumo": 20, "highway_env": 5}


_COUNTS = Rule(
    lambda counts: isinstance(counts, dict) and all(type(n) is int and n >= 2 for n in counts.values()),
    "names of traffics with whole numbers of at least 2",
)


@dataclass
class ReproduceConfig(RunConfig):
    """Every driver on every traffic, on the same episodes: tables and figures in one folder.

    Attributes:
        source: shipped: the agents that ship; scratch: train the paper's agents first, seed by seed (hours). May be
            given as from=.
        drivers: as agents of ganlane evaluate; agent_idm@all: every training of its recipe.
        traffics: options of the group traffic; what is not installed or not at hand is left out, with the reason.
        episodes: the episodes 0 to episodes - 1 of the seed.
        fewer: traffics on which driving is slow, with fewer episodes; the smaller number counts.
        num_envs: episodes driven side by side, at most.
        workers: processes that drive.
        cells: folder of what was driven; a pair of driver and traffic that is there is not driven again.
        runs: folders of training runs for the learning curves, each with the folder pretrain of its first phase.
        training_seeds: of source=scratch.
        trained: of source=scratch: folder of the trainings; those in it go on where they stopped.
        generator: weights of generated traffic.
        traffic_options: the traffics' keys.
    """

    source: str = "shipped"
    drivers: list[str] = field(default_factory=_drivers)
    traffics: list[str] = field(default_factory=_traffics)
    episodes: int = 1000
    fewer: dict[str, int] = field(default_factory=_fewer)
    num_envs: int = 512
    workers: int = 2
    cells: str = "outputs/cells"
    runs: list[str] = field(default_factory=list)
    training_seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    trained: str = "outputs/scratch"
    env: EnvConfig = field(default_factory=EnvConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    generator: GeneratorFile = field(default_factory=GeneratorFile)
    traffic_options: dict[str, TrafficConfig] = field(default_factory=all_traffics)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, source=one_of(SOURCES), drivers=NAMES, traffics=NAMES, fewer=_COUNTS)
        check(self, episodes=between(2, 10_000), num_envs=between(1, 65536), workers=between(1, 64))
        check(self, training_seeds=every(between(0, 2**53)))
        check_reward(self.env, self.reward)
        self.chosen_traffics()

    def chosen_traffics(self) -> dict[str, TrafficConfig]:
        """The traffics asked for, by name: options of the group, or import paths of a user's own."""
        return chosen_traffics("traffics", self.traffics, self.traffic_options)

    def episodes_on(self, traffic: str) -> int:
        """How many episodes are driven on a traffic."""
        return min(self.episodes, self.fewer.get(traffic, self.episodes))
