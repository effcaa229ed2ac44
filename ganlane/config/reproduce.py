"""Root of ``ganlane reproduce``."""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.config.evaluate import EvaluateConfig
from ganlane.config.run import NAMES
from ganlane.config.traffic import TRAFFICS
from ganlane.parameters.checks import Rule, between, check, every, one_of

SOURCES = ("shipped", "scratch")
_COUNTS = Rule(
    lambda counts: isinstance(counts, dict) and all(type(n) is int and n >= 2 for n in counts.values()),
    "names of traffics with whole numbers of at least 2",
)
_WITH_MOBIL = Rule(
    lambda names: "mobil" in names and len(names) > 1, "mobil and others, since every lead is one over mobil"
)


def _agents() -> list[str]:
    trained = ("agent_idm@all", "agent_gan@all", "agent_general")
    behind = [f"{agent}+{mask}" for agent in trained for mask in ("none", "legal", "safe")]
    return ["random_legal", "keep_lane", "mobil", "mobil_egoistic", *behind]


@dataclass
class ReproduceConfig(EvaluateConfig):
    """Every driver on every traffic, on the same episodes: tables and figures in one folder.

    Attributes:
        source: shipped: the agents that ship; scratch: train the paper's agents first, seed by seed (hours). May be
            given as from=.
        agents: as of ganlane evaluate; agent_idm@all: every training of its recipe.
        traffics: options of the group traffic; what is not installed or not at hand is left out, with the reason.
        fewer: traffics on which driving is slow, with fewer episodes; the smaller number counts.
        workers: processes that drive.
        cells: folder of what was driven; a pair of driver and traffic that is there is not driven again.
        runs: folders of training runs for the learning curves, each with the folder pretrain of its first phase.
        training_seeds: of source=scratch.
        trained: of source=scratch: folder of the trainings; those in it go on where they stopped.
    """

    source: str = "shipped"
    agents: list[str] = field(default_factory=_agents)
    traffics: list[str] = field(default_factory=lambda: [name for name in TRAFFICS if name != "mixed"])
    episodes: int = 1000
    fewer: dict[str, int] = field(
        default_factory=lambda: {"gan": 150, "gan_calibrated": 100, "replay": 200, "sumo": 8, "highway_env": 3}
    )
    workers: int = 2
    cells: str = "outputs/cells"
    runs: list[str] = field(default_factory=list)
    training_seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    trained: str = "outputs/scratch"

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, source=one_of(SOURCES), fewer=_COUNTS, episodes=between(2, 10_000), workers=between(1, 64))
        check(self, training_seeds=every(between(0, 2**53)))
        check(self, training_seeds=NAMES, agents=_WITH_MOBIL)

    def episodes_on(self, traffic: str) -> int:
        """How many episodes are driven on a traffic."""
        return min(self.episodes, self.fewer.get(traffic, self.episodes))
