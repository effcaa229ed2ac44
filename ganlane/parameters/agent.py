"""Rainbow's hyperparameters and switches."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ganlane.errors import ParameterError
from ganlane.parameters.checks import (
    Rule,
    above,
    at_least,
    between,
    check,
    every,
    lists_to_tuples,
    number,
    optional,
)

_DISCOUNT = Rule(lambda value: 0.0 < value <= 1.0, "a number above 0, at most 1")


@dataclass(frozen=True)
class RainbowConfig:
    """Hyperparameters of Rainbow (Hessel et al. 2018); the values are for one update of 256 per 64 decisions.

    Attributes:
        hidden: widths of the hidden layers.
        noisy: noisy layers; epsilon explores in addition to them.
        dueling: value and advantages in streams of their own.
        distributional: a distribution over returns (C51).
        double: double Q-learning.
        prioritised: prioritised replay.
        n_step: steps of the returns; 1: no multi-step returns.
        gamma: discount per decision.
        atoms: of the distribution over returns, 2 or more.
        v_min: lowest discounted return; what is below is clamped (metrics: clamped_fraction).
        v_max: highest discounted return.
        noisy_sigma: initial noise.
        batch_size: transitions per update.
        capacity: transitions in the replay buffer.
        warmup: transitions before the first update.
        decisions_per_update: decisions between two updates.
        target_period: updates between two copies of the target network.
        learning_rate: of Adam.
        learning_rate_end: it falls to this in a straight line; null: it stays.
        learning_rate_decisions: within so many decisions; 0: those of the phase (:meth:`for_phase`).
        adam_eps: of Adam; null: 0.005 / batch_size.
        gradient_clip: norm at which gradients are clipped.
        alpha: strength of the priorities, 0 to 1.
        beta_start: importance weights, rises to 1.
        beta_updates: within so many updates.
        kl_priority: priority by KL divergence, else by the expected error.
        epsilon_start: share of random legal actions at first; a trained agent (init=...) starts with epsilon.
        epsilon: share of random legal actions in the end (docs/agent.md).
        epsilon_decisions: decisions in which the one falls to the other.
    """

    hidden: tuple[int, ...] = (256, 256)
    noisy: bool = True
    dueling: bool = True
    distributional: bool = True
    double: bool = True
    prioritised: bool = True
    n_step: int = 3
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
        lists_to_tuples(self)
        counts = ["n_step", "batch_size", "capacity", "warmup", "decisions_per_update", "target_period", "atoms"]
        shares = ("alpha", "beta_start", "epsilon_start", "epsilon")
        check(
            self,
            hidden=every(at_least(1)),
            gamma=_DISCOUNT,
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
        self._check_together()

    def _check_together(self) -> None:
        if self.v_min >= self.v_max or (self.distributional and self.atoms < 2):
            raise ParameterError(
                f"{{v_min}}={self.v_min}, {{v_max}}={self.v_max}, {{atoms}}={self.atoms}: expected v_min below "
                "v_max and at least 2 atoms; widen the support."
            )
        if self.learning_rate_end is None and self.learning_rate_decisions > 0:
            raise ParameterError(
                f"{{learning_rate_decisions}}={self.learning_rate_decisions}: means nothing without "
                "{learning_rate_end}; give both or neither."
            )
        if not self.batch_size <= self.warmup <= self.capacity:
            raise ParameterError(
                f"{{warmup}}={self.warmup}: expected at least {{batch_size}}={self.batch_size} and at most "
                f"{{capacity}}={self.capacity} transitions."
            )

    def for_phase(self, decisions: int) -> RainbowConfig:
        """The same for a phase of ``decisions``, in which the learning rate falls unless it has a time of its own."""
        if self.learning_rate_end is not None and self.learning_rate_decisions == 0:
            return replace(self, learning_rate_decisions=decisions)
        return self
