"""Root of ``ganlane bench``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.run import COLUMNS, NAMES, has_cuda
from ganlane.config.traffic import TrafficConfig, all_traffics, chosen_traffics
from ganlane.errors import UserError
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.checks import Rule, between, check, every, one_of
from ganlane.parameters.observation import ObservationConfig
from ganlane.parameters.reward import RewardParameters

SUITES = ("sim", "traffic", "train")
MODES = ("eager", "compiled", "native")
DEVICES = ("cpu", "cuda")
_QUICK_BATCH = 64
_QUICK_STORED = 1000


def _different(rule: Rule) -> Rule:
    """A list of different entries, not empty, of which every one obeys ``rule``."""
    entries = every(rule)
    return Rule(
        lambda values: entries.holds(values) and NAMES.holds(values), f"{entries.expected}, all of them different"
    )


@dataclass
class BenchConfig:
    """What to measure, how often, and where to write it down.

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

    suite: str = "sim"
    quick: bool = False
    batches: list[int] = field(default_factory=lambda: [1, 16, 64, 256, 1024, 4096, 16384])
    modes: list[str] = field(default_factory=lambda: list(MODES))
    threads: list[int] = field(default_factory=lambda: [1, 2])
    devices: list[str] | None = None
    vehicle_counts: list[int] = field(default_factory=lambda: [9, 15, 30, 60])
    scaling_batch: int = 1024
    linear_from: int = 1024
    memory_batches: list[int] = field(default_factory=lambda: [1024, 4096])
    traffics: list[str] = field(default_factory=lambda: ["idm", "idm_mobil", "gan", "gan_calibrated"])
    traffic_batches: list[int] = field(default_factory=lambda: [512, 2048])
    train_traffics: list[str] = field(default_factory=lambda: ["idm_mobil", "gan"])
    train_batches: list[int] = field(default_factory=lambda: [256, 512, 1024])
    train_stored: int = 1_000_000
    repetitions: int = 5
    seconds: float = 0.5
    peers: bool = True
    memory: bool = True
    report: str | None = None
    seed: int = 0
    columns: str = "auto"
    env: EnvConfig = field(default_factory=EnvConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    reward: RewardParameters = field(default_factory=RewardParameters)
    agent: RainbowConfig = field(default_factory=RainbowConfig)

    def __post_init__(self) -> None:
        sizes = between(1, 2**20)
        check(
            self,
            suite=one_of(SUITES),
            columns=one_of(COLUMNS),
            batches=_different(sizes),
            modes=_different(one_of(MODES)),
            threads=_different(between(1, 1024)),
            vehicle_counts=_different(between(2, 1000)),
            scaling_batch=sizes,
            linear_from=sizes,
            traffics=NAMES,
            traffic_batches=_different(sizes),
            train_traffics=NAMES,
            train_batches=_different(sizes),
            repetitions=between(1, 1000),
            seconds=between(0.001, 600),
            seed=between(0, 2**53),
            memory_batches=Rule(
                lambda pair: len(pair) == 2 and all(map(sizes.holds, pair)) and pair[0] < pair[1],
                "two batch sizes, the smaller one first",
            ),
        )
        self._check_devices()
        self._check_stored()
        self.chosen_traffics()
        self.chosen_train_traffics()
        check_reward(self.env, self.reward)

    def chosen_traffics(self) -> dict[str, TrafficConfig]:
        """Those of ``suite=traffic``, by name."""
        return chosen_traffics("traffics", self.traffics, all_traffics(), own=False)

    def chosen_train_traffics(self) -> dict[str, TrafficConfig]:
        """Those of ``suite=train``, by name."""
        return chosen_traffics("train_traffics", self.train_traffics, all_traffics(), own=False)

    def _check_stored(self) -> None:
        least, most = self.agent.batch_size, self.agent.capacity
        if not least <= self.train_stored <= most:
            raise UserError(
                f"train_stored={self.train_stored}: expected at least agent.batch_size={least} and at most "
                f"agent.capacity={most} transitions."
            )

    def _check_devices(self) -> None:
        if self.devices is None:
            return
        check(self, devices=_different(one_of(DEVICES)))
        if "cuda" in self.devices and not has_cuda():
            raise UserError("devices: torch sees no CUDA device here; leave cuda out or install torch for CUDA.")

    def chosen_devices(self) -> tuple[str, ...]:
        """Those asked for; by default the CPU, and a GPU where there is one."""
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
