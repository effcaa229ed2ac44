"""Roots of the commands: what all share.

``ganlane evaluate``, ``reproduce``, ``record`` and ``bench``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, TypeAlias

from ganlane.config.env import EnvConfig, Vehicles, check_reward
from ganlane.config.traffic import TRAFFICS, TrafficConfig, all_traffics, chosen_traffics
from ganlane.errors import UserError
from ganlane.parameters import DIFFERENT, CountOrZero, Record, Rule, Seed, Text, between, one_of
from ganlane.parameters.agent import RainbowConfig
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


MODES = ("eager", "compiled", "native")
DEVICES = ("cpu", "cuda")
_QUICK_BATCH = 64
_QUICK_STORED = 1000

Batch: TypeAlias = Annotated[int, between(1, 2**20)]
Batches: TypeAlias = Annotated[list[Batch], DIFFERENT]
_PAIR = Rule(
    lambda pair: len(pair) == 2 and pair[0] < pair[1], "two batch sizes, the smaller one first"
)


@dataclass
class BenchConfig(Record):
    """What to measure, how often, and where to write the results.

    Attributes:
        suite: sim: the simulator, bare and as a whole environment; traffic: every traffic model;
            train: the training loop, compared with stable-baselines3 on HighwayEnv.
        quick: true: a check that it runs: small batches, two short repetitions, no memory, training
            in one mode.
        batches: environments side by side.
        modes: eager: env.kernel=torch; compiled: the same with env.compile=true; native:
            env.kernel=native. Training is compiled in the last two.
        threads: torch's threads; a GPU is measured with the first number alone.
        devices: [cpu], [cuda] or both; null: the CPU, and a GPU where there is one.
        vehicle_counts: for the growth with the vehicles, at the density of env=dense.
        scaling_batch: the batch at which that is measured.
        linear_from: batches from here on are measured side by side for the growth with the batch.
        memory_batches: memory per environment is measured between these two, each in a fresh
            process.
        traffics: of suite=traffic: options of the group traffic.
        traffic_batches: environments side by side, of suite=traffic.
        train_traffics: of suite=train: options of the group traffic.
        train_batches: environments side by side, of suite=train.
        train_stored: transitions in the replay buffer when the clock starts.
        repetitions: turns of every case; cases of a group take turns, medians are reported.
        seconds: a turn lasts about so long, or as long as one decision does, s.
        peers: a peer's simulator or learner in every group, if it is installed (extra 'bench';
            EnvPool by itself).
        memory: peak memory of every case, each in a fresh process.
        report: a document whose tables to rewrite, for instance docs/performance.md.
        seed: of all random numbers.
        columns: of printed tables; auto: as many as the terminal has room for; all.
    """

    suite: Annotated[str, one_of(("sim", "traffic", "train"))] = "sim"
    quick: bool = False
    batches: Batches = field(default_factory=lambda: [1, 16, 64, 256, 1024, 4096, 16384])
    modes: Annotated[list[Annotated[str, one_of(MODES)]], DIFFERENT] = field(
        default_factory=lambda: list(MODES)
    )
    threads: Annotated[list[Annotated[int, between(1, 1024)]], DIFFERENT] = field(
        default_factory=lambda: [1, 2]
    )
    devices: Annotated[list[Annotated[str, one_of(DEVICES)]], DIFFERENT] | None = None
    vehicle_counts: Annotated[list[Vehicles], DIFFERENT] = field(
        default_factory=lambda: [9, 15, 30, 60]
    )
    scaling_batch: Batch = 1024
    linear_from: Batch = 1024
    memory_batches: Annotated[list[Batch], _PAIR] = field(default_factory=lambda: [1024, 4096])
    traffics: Names = field(default_factory=lambda: ["idm", "idm_mobil", "gan", "gan_calibrated"])
    traffic_batches: Batches = field(default_factory=lambda: [512, 2048])
    train_traffics: Names = field(default_factory=lambda: ["idm_mobil", "gan"])
    train_batches: Batches = field(default_factory=lambda: [256, 512, 1024])
    train_stored: int = 1_000_000
    repetitions: Annotated[int, between(1, 1000)] = 5
    seconds: Annotated[float, between(0.001, 600)] = 0.5
    peers: bool = True
    memory: bool = True
    report: str | None = None
    seed: Seed = 0
    columns: Columns = "auto"
    env: EnvConfig = field(default_factory=EnvConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    reward: RewardParameters = field(default_factory=RewardParameters)
    agent: RainbowConfig = field(default_factory=RainbowConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if "cuda" in (self.devices or ()) and not has_cuda():
            raise UserError(
                "devices: torch sees no CUDA device here; leave cuda out or install torch for CUDA."
            )
        least, most = self.agent.batch_size, self.agent.capacity
        if not least <= self.train_stored <= most:
            raise UserError(
                f"train_stored={self.train_stored}: expected at least agent.batch_size={least} and at most "
                f"agent.capacity={most} transitions."
            )
        self.chosen_traffics()
        self.chosen_train_traffics()
        check_reward(self.env, self.reward)

    def chosen_traffics(self) -> dict[str, TrafficConfig]:
        """Traffics of ``suite=traffic``, by name."""
        return chosen_traffics("traffics", self.traffics, all_traffics(), own=False)

    def chosen_train_traffics(self) -> dict[str, TrafficConfig]:
        """Traffics of ``suite=train``, by name."""
        return chosen_traffics("train_traffics", self.train_traffics, all_traffics(), own=False)

    def chosen_devices(self) -> tuple[str, ...]:
        """The devices to measure; by default the CPU, and a GPU if there is one."""
        if self.devices is not None:
            return tuple(self.devices)
        return DEVICES if has_cuda() else DEVICES[:1]

    def shortened(self) -> BenchConfig:
        """With ``quick``, at most seconds of measuring: small batches, two short repetitions, no
        memory.

        Training is not compiled then: that alone takes longer.
        """
        if not self.quick:
            return self
        return replace(
            self,
            batches=[batch for batch in self.batches if batch <= _QUICK_BATCH] or [1],
            threads=self.threads[:1],
            vehicle_counts=self.vehicle_counts[:2],
            traffic_batches=[min(*self.traffic_batches, _QUICK_BATCH)],
            train_batches=[min(*self.train_batches, _QUICK_BATCH)],
            train_stored=min(self.train_stored, max(_QUICK_STORED, self.agent.batch_size)),
            modes=self.modes[:1] if self.suite == "train" else self.modes,
            scaling_batch=min(self.scaling_batch, _QUICK_BATCH),
            repetitions=min(self.repetitions, 2),
            seconds=min(self.seconds, 0.01),
            memory=False,
        )
