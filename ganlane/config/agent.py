"""``agent=...``: Rainbow, and what can be switched off in it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from ganlane.config.observation import LISTS, ObservationConfig
from ganlane.config.plain import plain_copy
from ganlane.errors import UserError
from ganlane.parameters.checks import above, at_least, between, check, every, number, one_of, optional

if TYPE_CHECKING:
    from ganlane.agents import RainbowConfig
    from ganlane.config.env import EnvConfig

#: As in :data:`ganlane.agents.encoder.ENCODERS`; repeated here so that a wrong name is found without loading torch.
ENCODERS = ("none", "shared")


@dataclass
class AgentConfig:
    """``agent=rainbow``: all of :class:`ganlane.agents.RainbowConfig`."""

    hidden: list[int] = field(default_factory=lambda: [256, 256])
    encoder: str = "none"
    encoder_width: int = 64
    encoder_layers: int = 2
    noisy: bool = True
    dueling: bool = True
    distributional: bool = True
    double: bool = True
    prioritised: bool = True
    n_step: int = 3
    decide_when_free: bool = False
    gamma: float = 0.98
    atoms: int = 101
    v_min: float = -120.0
    v_max: float = 100.0
    noisy_sigma: float = 0.5
    batch_size: int = 256
    capacity: int = 1_000_000
    warmup: int = 10_000
    decisions_per_update: int = 64
    target_period: int = 500
    learning_rate: float = 2.5e-4
    learning_rate_end: float | None = None
    learning_rate_decisions: int = 0
    adam_eps: float | None = None
    gradient_clip: float = 10.0
    alpha: float = 0.5
    beta_start: float = 0.4
    beta_updates: int = 100_000
    kl_priority: bool = True
    epsilon_start: float = 1.0
    epsilon: float = 0.04
    epsilon_decisions: int = 300_000

    def __post_init__(self) -> None:
        counts = ["n_step", "batch_size", "capacity", "warmup", "decisions_per_update", "target_period", "atoms"]
        counts += ["encoder_width", "encoder_layers"]
        shares = ("alpha", "beta_start", "epsilon_start", "epsilon")
        check(
            self,
            "agent",
            hidden=every(at_least(1)),
            encoder=one_of(ENCODERS),
            gamma=between(0, 1),
            v_min=number(),
            v_max=number(),
            noisy_sigma=at_least(0),
            learning_rate=above(0),
            learning_rate_end=optional(above(0)),
            learning_rate_decisions=at_least(0),
            adam_eps=optional(above(0)),
            gradient_clip=above(0),
            beta_updates=at_least(0),
            epsilon_decisions=at_least(0),
            **dict.fromkeys(counts, at_least(1)),
            **dict.fromkeys(shares, between(0, 1)),
        )
        self.rainbow()

    def rainbow(self, decisions: int = 1) -> RainbowConfig:
        """As the agent takes it for a phase of ``decisions``; checks what concerns several keys at once."""
        from ganlane.agents import RainbowConfig

        if self.learning_rate_end is not None and self.learning_rate_decisions == 0:
            return plain_copy(replace(self, learning_rate_decisions=decisions), RainbowConfig)
        return plain_copy(self, RainbowConfig)


@dataclass
class DqnConfig(AgentConfig):
    """``agent=dqn``: plain DQN (Mnih et al. 2015), every component of Rainbow switched off."""

    noisy: bool = False
    dueling: bool = False
    distributional: bool = False
    double: bool = False
    prioritised: bool = False
    n_step: int = 1


def check_agent(agent: AgentConfig, observation: ObservationConfig, env: EnvConfig) -> None:
    """Refuse an agent that could not read the observation, or would not learn what it is asked in ``env``.

    Raises:
        UserError: an encoder over vehicles without a list of them, or turning back while nothing is learnt.
    """
    if agent.encoder != "none" and observation.form not in LISTS:
        raise UserError(
            f"agent.encoder={agent.encoder} with observation={observation.form}: the encoder reads vehicles in Table "
            f"III's layout; give one of {', '.join(LISTS)}, or agent.encoder=none."
        )
    if agent.decide_when_free and env.ego.abort_lane_change:
        raise UserError(
            "agent.decide_when_free=true with env.ego.abort_lane_change=true: commands are then obeyed during a lane "
            "change, but nothing would be learnt from them; switch one of the two off."
        )
