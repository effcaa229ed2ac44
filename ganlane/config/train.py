"""Root of ``ganlane train``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ganlane.config.collector import CollectorConfig
from ganlane.config.env import EnvConfig, check_pay
from ganlane.config.evaluate import NAMES
from ganlane.config.init import InitConfig
from ganlane.config.logger import LoggerConfig
from ganlane.config.observation import ObservationConfig
from ganlane.config.run import GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.parameters.agent import RainbowConfig
from ganlane.parameters.checks import at_least, between, check, one_of
from ganlane.parameters.observation import MaskParameters
from ganlane.parameters.reward import RewardParameters

COMPILE = ("auto", "always", "never")
#: Compiling takes one to two minutes, which a training of so many decisions gets back.
WORTH_COMPILING = 300_000


@dataclass
class PretrainConfig:
    """``pretrain``: a first phase on other traffic, whose agent the main phase starts from."""

    total_decisions: int = 0
    traffic: TrafficConfig | None = None

    def __post_init__(self) -> None:
        check(self, "pretrain", total_decisions=at_least(0))
        if self.total_decisions > 0 and self.traffic is None:
            raise UserError(
                f"pretrain.total_decisions={self.total_decisions}: on which traffic? give for instance "
                "traffic@pretrain.traffic=idm_mobil."
            )


@dataclass
class FinalEvaluationConfig:
    """``evaluation``: the trained agent beside others, on the same episodes, when training is over."""

    agents: list[str] = field(default_factory=lambda: ["mobil", "agent_idm", "random_legal"])
    traffic: TrafficConfig | None = None
    episodes: int = 500
    num_envs: int = 512

    def __post_init__(self) -> None:
        check(self, "evaluation", agents=NAMES, episodes=at_least(1), num_envs=between(1, 65536))


@dataclass
class TrainConfig(RunConfig):
    """Everything that ``ganlane train`` can be told.

    ``compile``: whether the training is compiled (the final evaluation is with ``env.compile=true`` alone). ``auto``:
    where compiling is known to work (:func:`ganlane.runtime.can_compile`) and the training is long enough to gain
    by it (:data:`WORTH_COMPILING`).
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
            "",
            total_decisions=at_least(1),
            compile=one_of(COMPILE),
            log_every=at_least(1),
            evaluate_every=at_least(0),
            selection_episodes=at_least(1),
            checkpoint_every_s=at_least(0),
        )
        check_pay(self.env, self.reward)

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
