"""Configuration of ``ganlane bench``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, TypeAlias

from ganlane.config.env import EnvConfig, Vehicles, check_reward
from ganlane.config.run import Columns, Names, has_cuda
from ganlane.config.traffic import TrafficConfig, all_traffics, chosen_traffics
from ganlane.errors import UserError
from ganlane.parameters import DIFFERENT, Record, Rule, Seed, between, one_of
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.observation import ObservationConfig, RewardParameters

MODES = ("eager", "compiled", "native")
DEVICES = ("cpu", "cuda")
_QUICK_BATCH = 64
_QUICK_STORED = 1000

Batch: TypeAlias = Annotated[int, between(1, 2**20)]
Batches: TypeAlias = Annotated[list[Batch], DIFFERENT]
_PAIR = Rule(lambda pair: len(pair) == 2 and pair[0] < pair[1], "two batch sizes, the smaller one first")


@dataclass
class BenchConfig(Record):
    """What to measure, how often, and where to write the results.

    Attributes:
        suite: sim: the simulator, bare and as a whole environment; traffic: every traffic model; train: the training
            loop, compared with stable-baselines3 on HighwayEnv.
        quick: true: a check that it runs: small batches, two short repetitions, no memory, training in one mode.
        batches: environments side by side.
        modes: eager: env.kernel=torch; compiled: the same with env.compile=true; native: env.kernel=native.
            Training is compiled in the last two.
        threads: torch's threads; a GPU is measured with the first number alone.
        devices: [cpu], [cuda] or both; null: the CPU, and a GPU where there is one.
        vehicle_counts: for the growth with the vehicles, at the density of env=dense.
        scaling_batch: the batch at which that is measured.
        linear_from: batches from here on are measured side by side for the growth with the batch.
        memory_batches: memory per environment is measured between these two, each in a fresh process.
        traffics: of suite=traffic: options of the group traffic.
        traffic_batches: environments side by side, of suite=traffic.
        train_traffics: of suite=train: options of the group traffic.
        train_batches: environments side by side, of suite=train.
        train_stored: transitions in the replay buffer when the clock starts.
        repetitions: turns of every case; cases of a group take turns, medians are reported.
        seconds: a turn lasts about so long, or as long as one decision does, s.
        peers: a peer's simulator or learner in every group, if it is installed (extra 'bench'; EnvPool by itself).
        memory: peak memory of every case, each in a fresh process.
        report: a document whose tables to rewrite, for instance docs/performance.md.
        seed: of all random numbers.
        columns: of printed tables; auto: as many as the terminal has room for; all.
    """

    suite: Annotated[str, one_of(("sim", "traffic", "train"))] = "sim"
    quick: bool = False
    batches: Batches = field(default_factory=lambda: [1, 16, 64, 256, 1024, 4096, 16384])
    modes: Annotated[list[Annotated[str, one_of(MODES)]], DIFFERENT] = field(default_factory=lambda: list(MODES))
    threads: Annotated[list[Annotated[int, between(1, 1024)]], DIFFERENT] = field(default_factory=lambda: [1, 2])
    devices: Annotated[list[Annotated[str, one_of(DEVICES)]], DIFFERENT] | None = None
    vehicle_counts: Annotated[list[Vehicles], DIFFERENT] = field(default_factory=lambda: [9, 15, 30, 60])
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
            raise UserError("devices: torch sees no CUDA device here; leave cuda out or install torch for CUDA.")
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
        """With ``quick``, at most seconds of measuring: small batches, two short repetitions, no memory.

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
