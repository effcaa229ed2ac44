"""``ganlane train``: its root, and the groups ``init``, ``collector`` and ``logger``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.run import EPISODES, NAMES, GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import ParameterError
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.checks import at_least, between, check, one_of, optional, text
from ganlane.parameters.observation import MaskParameters, ObservationConfig
from ganlane.parameters.reward import RewardParameters

COMPILE = ("auto", "always", "never")
#: Compiling takes one to two minutes, which a training of so many decisions gets back.
WORTH_COMPILING = 300_000
#: Whose support of returns: that of the run's own ``agent``, or that of the trained agent.
SUPPORTS = ("run", "trained")


@dataclass
class InitConfig:
    """``init=idm_ckpt``: start from a trained agent.

    Attributes:
        path: a shipped agent's name, a .safetensors file, or a training run's folder or last.pt.
        support: trained: its atoms, v_min and v_max instead of those of agent; run: both must agree.
        optimizer: true: Adam's moments too; they are in a run's last.pt, not in a .safetensors file.
    """

    path: str | None = "agent_idm"
    support: str = "run"
    optimizer: bool = False

    def __post_init__(self) -> None:
        check(self, support=one_of(SUPPORTS))
        asked = "{optimizer}=true" if self.optimizer else "{support}=trained"
        if self.path is None and (self.optimizer or self.support == "trained"):
            raise ParameterError(
                f"{asked}: of which agent? give init=idm_ckpt, and {{path}}=PATH unless the shipped one."
            )


@dataclass
class NoInitConfig(InitConfig):
    """``init=none``: start from random weights."""

    path: str | None = None

    def __post_init__(self) -> None:
        if self.path is not None:
            raise ParameterError(
                f"{{path}}={self.path}: init=none starts afresh; use init=idm_ckpt {{path}}={self.path}."
            )
        super().__post_init__()


@dataclass
class CollectorConfig:
    """``collector=single``: one process steps all environments side by side.

    Attributes:
        num_envs: environments of the process, 1 to 65536; a step of the loop has a decision of each.
    """

    num_envs: int = 512

    def __post_init__(self) -> None:
        check(self, num_envs=between(1, 65536))

    @property
    def environments(self) -> int:
        """Decisions per step of the loop, over all processes."""
        return self.num_envs


@dataclass
class OverlapCollectorConfig(CollectorConfig):
    """``collector=overlap``: worker processes drive while this one learns.

    Attributes:
        num_envs: environments of all workers, which share them out evenly.
        workers: processes, with one thread each.
    """

    workers: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, workers=between(1, 1024))
        if self.num_envs % self.workers:
            raise ParameterError(
                f"{{num_envs}}={self.num_envs}: cannot be shared out evenly between {{workers}}={self.workers}; "
                "give a multiple."
            )


@dataclass
class MultiCollectorConfig(CollectorConfig):
    """``collector=multi``: worker processes on this machine.

    Attributes:
        num_envs: environments of each worker; a step of the loop has workers * num_envs decisions.
        workers: processes, with one thread each.
        weights_every: decisions, over all workers, between two updates of the workers' weights.
    """

    num_envs: int = 64
    workers: int = 2
    weights_every: int = 1024

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, workers=between(1, 1024), weights_every=at_least(1))

    @property
    def environments(self) -> int:
        """Decisions per step of the loop, over all workers."""
        return self.workers * self.num_envs


@dataclass
class RayCollectorConfig(MultiCollectorConfig):
    """``collector=ray``: the same on a Ray cluster.

    Attributes:
        address: of the cluster's head: HOST:6379, ray://HOST:10001 or auto; null: a Ray of its own here.
    """

    address: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, address=optional(text()))


@dataclass
class LoggerConfig:
    """``logger=...``: where the figures of a training run go in addition to ``metrics.csv``.

    Attributes:
        kind: csv: nowhere else; tensorboard: event files in the run folder; wandb: Weights & Biases.
        progress: a bar on a terminal, plain lines elsewhere.
        project: of Weights & Biases.
    """

    kind: str = "csv"
    progress: bool = True
    project: str = "ganlane"

    def __post_init__(self) -> None:
        check(self, kind=one_of(("csv", "tensorboard", "wandb")), project=text())


@dataclass
class PretrainConfig:
    """``pretrain``: a first phase on other traffic, whose agent the main phase starts from.

    Attributes:
        total_decisions: 0: no such phase.
        traffic: traffic@pretrain.traffic=idm_mobil.
    """

    total_decisions: int = 0
    traffic: TrafficConfig | None = None

    def __post_init__(self) -> None:
        check(self, total_decisions=at_least(0))
        if self.total_decisions > 0 and self.traffic is None:
            raise ParameterError(
                f"{{total_decisions}}={self.total_decisions}: on which traffic? give for instance "
                "traffic@pretrain.traffic=idm_mobil."
            )


@dataclass
class FinalEvaluationConfig:
    """``evaluation``: the trained agent and others on the same episodes, when training is over.

    Attributes:
        agents: to compare the trained one with.
        traffic: traffic@evaluation.traffic=NAME for another traffic than that of training.
        episodes: the episodes 0 to episodes - 1 of the seed, on the stream kept for reports.
        num_envs: episodes driven side by side, at most.
    """

    agents: list[str] = field(default_factory=lambda: ["mobil", "agent_idm", "random_legal"])
    traffic: TrafficConfig | None = None
    episodes: int = 500
    num_envs: int = 512

    def __post_init__(self) -> None:
        check(self, agents=NAMES, episodes=EPISODES, num_envs=between(1, 65536))


@dataclass
class TrainConfig(RunConfig):
    """Inputs of a training run.

    Attributes:
        total_decisions: of all environments together.
        compile: always, never; auto: where compiling is known to work (:func:`ganlane.runtime.can_compile`) and the
            training is long enough to gain by it (:data:`WORTH_COMPILING`). The final evaluation is compiled with
            ``env.compile=true`` alone.
        log_every: decisions between two rows of metrics.csv.
        evaluate_every: decisions between two evaluations while training (0: none); the best agent is kept.
        selection_episodes: of each of those, on the stream kept for model selection.
        checkpoint_every_s: seconds between two resume checkpoints.
        checkpoint_replay: with the replay buffer: needed for a resumed run to be exact.
        resume: PATH of a run's folder or checkpoint to go on with, or auto (the newest unfinished run).
        generator: weights of generated traffic.
        pretrain: a first phase on other traffic.
        evaluation: when training is over.
    """

    total_decisions: int = 600_000
    compile: str = "auto"
    log_every: int = 10_000
    evaluate_every: int = 0
    selection_episodes: int = 64
    checkpoint_every_s: float = 20.0
    checkpoint_replay: bool = True
    resume: str | None = None
    env: EnvConfig = field(default_factory=EnvConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    init: InitConfig = field(default_factory=InitConfig)
    agent: RainbowConfig = field(default_factory=RainbowConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    mask: MaskParameters = field(default_factory=MaskParameters)
    reward: RewardParameters = field(default_factory=RewardParameters)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    generator: GeneratorFile = field(default_factory=GeneratorFile)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    evaluation: FinalEvaluationConfig = field(default_factory=FinalEvaluationConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self,
            total_decisions=at_least(1),
            compile=one_of(COMPILE),
            log_every=at_least(1),
            evaluate_every=at_least(0),
            selection_episodes=EPISODES,
            checkpoint_every_s=at_least(0),
        )
        check_reward(self.env, self.reward)

    def compiled(self) -> TrainConfig:
        """The same with ``env.compile`` as ``compile`` says."""
        from ganlane.runtime import can_compile

        worth = self.total_decisions >= WORTH_COMPILING and can_compile()
        if self.env.compile or self.compile == "never" or (self.compile == "auto" and not worth):
            return self
        return replace(self, env=replace(self.env, compile=True))

    def all_traffic(self) -> list[TrafficConfig]:
        """Every traffic that this run drives in."""
        first = [] if self.pretrain.traffic is None else [self.pretrain.traffic]
        return [*first, self.traffic, *self.evaluation_traffic().values()]

    def evaluation_traffic(self) -> dict[str, TrafficConfig]:
        """The traffic of the final evaluation by its name: training's, unless another one was chosen."""
        chosen = self.evaluation.traffic or self.traffic
        return {chosen.label(): chosen}
