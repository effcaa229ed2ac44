"""``ganlane train``: the run, and the groups ``init`` and ``logger``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from ganlane.errors import ParameterError
from ganlane.settings.agent import RainbowConfig
from ganlane.settings.commands import DrivingConfig, Environments, Episodes, EvaluateConfig, Names
from ganlane.settings.record import Count, CountOrZero, NotNegative, Record, Text, one_of
from ganlane.settings.traffic import IdmMobilTrafficConfig, TrafficConfig

#: Number of decisions above which compiling (one to two minutes) pays off.
WORTH_COMPILING = 300_000


@dataclass(frozen=True)
class InitConfig(Record):
    """``init=idm_ckpt``: start from a trained agent; ``init=none``: from random weights.

    Attributes:
        path: a shipped agent's name, a .safetensors file, or a finished training's folder; null:
            random weights.
    """

    group = "init"

    path: str | None = None


@dataclass(frozen=True)
class LoggerConfig(Record):
    """``logger=...``: logs of a training run in addition to ``metrics.csv``.

    Attributes:
        kind: csv: nowhere else; tensorboard: event files in the run folder; wandb: Weights &
            Biases.
        progress: a bar on a terminal, plain lines elsewhere.
        project: of Weights & Biases.
    """

    group = "logger"

    kind: Annotated[str, one_of(("csv", "tensorboard", "wandb"))] = "csv"
    progress: bool = True
    project: Text = "ganlane"


@dataclass(frozen=True)
class PretrainConfig(Record):
    """``pretrain``: a first phase on other traffic, whose agent the main phase starts from.

    Attributes:
        total_decisions: 0: no such phase.
        traffic: pretrain.traffic=idm_mobil.
    """

    total_decisions: CountOrZero = 0
    traffic: TrafficConfig | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.total_decisions > 0 and self.traffic is None:
            raise ParameterError(
                f"{{total_decisions}}={self.total_decisions}: on which traffic? give for instance "
                "{traffic}=idm_mobil."
            )


@dataclass(frozen=True)
class FinalEvaluationConfig(Record):
    """``evaluation``: the trained agent and others on the same episodes, when training is over.

    Attributes:
        agents: to compare the trained one with.
        traffic: evaluation.traffic=NAME for another traffic than that of training; null: that one.
        episodes: the episodes 0 to episodes - 1 of the seed, on the stream kept for reports.
        num_envs: episodes driven side by side, at most.
    """

    # a rule-driven driver, the shipped agent, and a random driver for the normalised score
    agents: Names = field(default_factory=lambda: ["mobil", "agent_idm", "random_legal"])
    traffic: TrafficConfig | None = None
    episodes: Episodes = 500
    num_envs: Environments = 512


@dataclass(frozen=True)
class TrainConfig(DrivingConfig):
    """Inputs of a training run.

    Attributes:
        total_decisions: of all environments together.
        num_envs: environments side by side, 1 to 65536; a step of the loop has a decision of each.
        compile: the agent's update as one graph: always, never; auto: where compiling is known to
            work (:func:`ganlane.torch_settings.can_compile`) and the training is long enough to
            gain by it (:data:`WORTH_COMPILING`).
        log_every: decisions between two rows of metrics.csv.
        evaluate_every: decisions between two evaluations while training (0: none); the best agent
            is kept.
        selection_episodes: of each of those, on the stream kept for model selection.
        checkpoint_every_s: seconds between two resume checkpoints.
        checkpoint_replay: with the replay buffer: needed for a resumed run to be exact.
        resume: PATH of a run's folder or checkpoint to go on with, or auto (the newest unfinished
            run).
        pretrain: a first phase on other traffic.
        evaluation: when training is over.
    """

    # how long, and what is written on the way
    total_decisions: Count = 600_000
    num_envs: Environments = 512
    compile: Annotated[str, one_of(("auto", "always", "never"))] = "auto"
    log_every: Count = 10_000
    evaluate_every: CountOrZero = 0
    selection_episodes: Episodes = 64
    # no more work than this is lost if the run is killed
    checkpoint_every_s: NotNegative = 20.0
    checkpoint_replay: bool = True
    # going on with a run; none of the settings of the run itself
    resume: str | None = None
    # on what, from what, by which agent
    traffic: TrafficConfig = IdmMobilTrafficConfig()
    init: InitConfig = InitConfig()
    agent: RainbowConfig = RainbowConfig()
    logger: LoggerConfig = LoggerConfig()
    # the phase before, and the comparison after
    pretrain: PretrainConfig = PretrainConfig()
    evaluation: FinalEvaluationConfig = FinalEvaluationConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.env.actions.names:
            raise ParameterError(
                f"{{env.actions.form}}={self.env.actions.form}: Rainbow chooses among numbered "
                "actions; take lane or lane_speed, or train with stable-baselines3."
            )

    def compiles(self) -> bool:
        """Whether the agent's update is compiled."""
        # Imported here, since it imports torch, which takes seconds.
        from ganlane.torch_settings import can_compile

        if self.compile == "auto":
            # Compiling takes a minute: the benefit has to be larger.
            return self.total_decisions >= WORTH_COMPILING and can_compile()
        return self.compile == "always"

    def all_traffic(self) -> list[TrafficConfig]:
        """Every traffic of the run."""
        first = [] if self.pretrain.traffic is None else [self.pretrain.traffic]
        return [*first, self.traffic, self.evaluation.traffic or self.traffic]

    def final_evaluation(self) -> EvaluateConfig:
        """Config of the final comparison, by default on the traffic of the training."""
        # The trained agent's mask stays with the agent, so the comparison sets none.
        traffic = self.evaluation.traffic or self.traffic
        return EvaluateConfig(
            seed=self.seed,
            device=self.device,
            env=self.env,
            observation=self.observation,
            reward=self.reward,
            traffics={traffic.label(): traffic},
            episodes=self.evaluation.episodes,
            num_envs=self.evaluation.num_envs,
        )
