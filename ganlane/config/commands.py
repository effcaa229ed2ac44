"""Roots of the commands: what all share.

``ganlane evaluate``, ``reproduce`` and ``record``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.traffic import TRAFFICS, TrafficConfig, all_traffics, chosen_traffics
from ganlane.errors import UserError
from ganlane.parameters import DIFFERENT, CountOrZero, Record, Rule, Seed, Text, between, one_of
from ganlane.parameters.observation import MaskParameters, ObservationConfig, RewardParameters

#: Number of environments in a batch.
Environments: TypeAlias = Annotated[int, between(1, 65536)]
#: A number of episodes; their results stay in memory.
Episodes: TypeAlias = Annotated[int, between(1, 10_000_000)]
#: Names without repetitions.
Names: TypeAlias = Annotated[list[str], DIFFERENT]
#: Columns of printed tables.
Columns: TypeAlias = Annotated[str, one_of(("auto", "all"))]


@dataclass
class RunConfig(Record):
    """Keys of every command.

    Attributes:
        seed: of all random numbers.
        threads: torch's threads; 0: one, which measured fastest (more are far slower where other
            work runs).
        device: cpu or cuda.
        columns: of printed tables; auto: as many as the terminal has room for; all.
    """

    seed: Seed = 0
    threads: CountOrZero = 0
    device: Annotated[str, one_of(("cpu", "cuda"))] = "cpu"
    columns: Columns = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.device == "cuda" and not has_cuda():
            raise UserError(
                "device=cuda: torch sees no CUDA device here; use device=cpu or install torch for CUDA."
            )


def has_cuda() -> bool:
    """Whether torch sees a CUDA device."""
    import torch

    return torch.cuda.is_available()


@dataclass
class GeneratorFile:
    """``generator``: weights of generated traffic.

    Attributes:
        path: weights for gan and gan_calibrated; null: the ones that ship.
    """

    path: str | None = None


@dataclass
class DrivingConfig(RunConfig):
    """Keys of every command that drives an environment.

    Attributes:
        generator: weights of generated traffic.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    generator: GeneratorFile = field(default_factory=GeneratorFile)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_reward(self.env, self.reward)


#: Episodes of ``ganlane reproduce`` on slow traffics, so that the whole takes half an hour.
FEWER = {
    "idm_faults": 500,
    "idm_random": 400,
    "gan": 120,
    "gan_calibrated": 100,
    "replay": 100,
    "sumo": 8,
    "highway_env": 3,
}
_COUNTS = Rule(
    lambda counts: (
        counts is None
        or (isinstance(counts, dict) and all(type(n) is int and n >= 2 for n in counts.values()))
    ),
    "names of traffics with whole numbers of at least 2",
)
_WITH_MOBIL = Rule(
    lambda names: "mobil" in names and len(names) > 1,
    "mobil and others, since every lead is one over mobil",
)
_DATASET = Rule(
    lambda name: re.fullmatch(r"(\w[\w-]*/)*\w[\w-]*-v\d+", name, re.ASCII) is not None,
    "a name such as highway/mobil-v0, its parts of letters, digits, - and _",
)


@dataclass
class EvaluateConfig(DrivingConfig):
    """Agents x traffics, the same episodes for all of them.

    Attributes:
        agents: mobil, mobil_egoistic, keep_lane, random_legal, random; agent_idm and others that
            ship (agent_idm@1: its recipe trained with seed 1, agent_idm@all: with every seed there
            is); a checkpoint's path; the import path of a policy of your own. The normalised score
            needs mobil and random_legal.
        traffics: options of the group traffic, or the import path of a traffic model of your own.
        episodes: the episodes 0 to episodes - 1 of the seed and stream.
        num_envs: episodes driven side by side, at most.
        stream: select: the episodes kept for choosing among recipes, never for a reported figure.
        traffic_options: the traffics' keys.
    """

    agents: Names = field(
        default_factory=lambda: ["mobil", "keep_lane", "random_legal", "agent_idm"]
    )
    traffics: Names = field(default_factory=lambda: ["idm", "idm_mobil", "gan", "gan_calibrated"])
    episodes: Episodes = 100
    num_envs: Environments = 512
    stream: Annotated[str, one_of(("report", "select"))] = "report"
    traffic_options: dict[str, TrafficConfig] = field(default_factory=all_traffics)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.chosen_traffics()

    def chosen_traffics(self) -> dict[str, TrafficConfig]:
        """The traffics asked for, by name: options of the group, or import paths of a user's own."""
        return chosen_traffics("traffics", self.traffics, self.traffic_options)


def _paper_agents() -> list[str]:
    behind = [
        f"{agent}@all+{mask}"
        for agent in ("agent_idm", "agent_gan")
        for mask in ("none", "legal", "safe")
    ]
    return [
        "random_legal",
        "keep_lane",
        "mobil",
        "mobil_egoistic",
        *behind,
        "agent_general@all+safe",
    ]


@dataclass
class ReproduceConfig(EvaluateConfig):
    """Every driver on every traffic, on the same episodes: tables and figures in one folder.

    Attributes:
        source: shipped: the agents that ship; scratch: train the paper's agents first, seed by seed
            (hours). May be given as from=.
        agents: as of ganlane evaluate; agent_idm@all: every training of its recipe.
        traffics: options of the group traffic; what is not installed or not at hand is left out,
            with the reason.
        fewer: number of episodes on slow traffics, where it is smaller than episodes; it changes or
            adds to {idm_faults: 500, idm_random: 400, gan: 120, gan_calibrated: 100, replay: 100,
            sumo: 8, highway_env: 3}.
        workers: processes that drive.
        cells: folder of what was driven; a pair of driver and traffic that is there is not driven
            again.
        crashes: so many per driver and traffic, the earliest, are listed in crashes.json with their
            actions.
        runs: folders of training runs for the learning curves, each with the folder pretrain of its
            first phase.
        training_seeds: of source=scratch.
        trained: of source=scratch: folder of the trainings; those in it go on where they stopped.
    """

    source: Annotated[str, one_of(("shipped", "scratch"))] = "shipped"
    agents: Annotated[Names, _WITH_MOBIL] = field(default_factory=_paper_agents)
    traffics: Names = field(default_factory=lambda: [name for name in TRAFFICS if name != "mixed"])
    episodes: Annotated[int, between(2, 10_000)] = 1000
    # Of a free type: Hydra would refuse names that a typed default does not have.
    fewer: Annotated[Any, _COUNTS] = None
    workers: Annotated[int, between(1, 64)] = 2
    cells: str = "outputs/cells"
    crashes: Annotated[int, between(0, 100)] = 3
    runs: list[str] = field(default_factory=list)
    training_seeds: Annotated[list[Seed], DIFFERENT] = field(
        default_factory=lambda: [0, 1, 2, 3, 4]
    )
    trained: str = "outputs/scratch"

    def episodes_on(self, traffic: str) -> int:
        """Number of episodes on a traffic."""
        fewer = {**FEWER, **(self.fewer or {})}
        return min(self.episodes, fewer.get(traffic, self.episodes))


@dataclass
class RecordConfig(DrivingConfig):
    """A driver's episodes as an offline dataset.

    Attributes:
        driver: agent=NAME says the same: a name, path or import path as in ganlane evaluate.
        episodes: the episodes 0 to episodes - 1 of the seed and stream.
        num_envs: episodes driven side by side, at most.
        stream: train, select or report (the episodes of ganlane evaluate).
        out: folder of the datasets, Minari's MINARI_DATASETS_PATH; null: the run folder.
        dataset: the dataset's name; null: ganlane/TRAFFIC/DRIVER-v0.
    """

    driver: str = "mobil"
    episodes: Episodes = 100
    num_envs: Environments = 64
    stream: Annotated[str, one_of(("train", "select", "report"))] = "train"
    out: Text | None = None
    dataset: Annotated[str, _DATASET] | None = None
    traffic: TrafficConfig = field(default_factory=TrafficConfig)

    def dataset_name(self) -> str:
        """The dataset's name; by default made from traffic and driver."""
        parts = (
            re.sub(r"[^A-Za-z0-9_]+", "_", part).strip("_")
            for part in (self.traffic.label(), self.driver)
        )
        return self.dataset or f"ganlane/{'/'.join(parts)}-v0"
