"""Rainbow's hyperparameters and switches."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ganlane.errors import ParameterError
from ganlane.settings.record import (
    Count,
    CountOrZero,
    NotNegative,
    Number,
    Positive,
    PositiveShare,
    Record,
    Share,
)


@dataclass(frozen=True)
class RainbowConfig(Record):
    """Hyperparameters of Rainbow (Hessel et al. 2018), for one update of 256 per 64 decisions.

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
        learning_rate_decisions: within so many decisions; 0: those of the phase
            (:meth:`for_phase`).
        adam_eps: of Adam; null: 0.005 / batch_size.
        gradient_clip: norm at which gradients are clipped.
        alpha: strength of the priorities, 0 to 1.
        beta_start: importance weights, rises to 1.
        beta_updates: within so many updates.
        kl_priority: priority by KL divergence, else by the expected error.
        epsilon_start: share of random legal actions at first; a trained agent (init=...) starts
            with epsilon.
        epsilon: share of random legal actions in the end (docs/agent.md).
        epsilon_decisions: decisions in which the one falls to the other.
    """

    group = "agent"

    # the network, and Rainbow's six components, each of which can be left out
    hidden: tuple[Count, ...] = (256, 256)
    noisy: bool = True
    dueling: bool = True
    distributional: bool = True
    double: bool = True
    prioritised: bool = True
    # what is learned: the distribution of discounted returns
    n_step: Count = 3
    gamma: PositiveShare = 0.98
    atoms: Count = 101
    v_min: Number = -120.0
    v_max: Number = 100.0
    noisy_sigma: NotNegative = 0.5
    # replay buffer and updates
    batch_size: Count = 256
    capacity: Count = 1_000_000
    warmup: Count = 10_000
    decisions_per_update: Count = 64
    target_period: Count = 500
    # the optimiser
    learning_rate: Positive = 2.5e-4
    learning_rate_end: Positive | None = None
    learning_rate_decisions: CountOrZero = 0
    adam_eps: Positive | None = None
    gradient_clip: Positive = 10.0
    # prioritised replay
    alpha: Share = 0.5
    beta_start: Share = 0.4
    beta_updates: CountOrZero = 100_000
    kl_priority: bool = True
    # random actions
    epsilon_start: Share = 1.0
    epsilon: Share = 0.04
    epsilon_decisions: CountOrZero = 300_000

    def __post_init__(self) -> None:
        super().__post_init__()
        # checks of single values are in the annotations above; these are between several
        if self.v_min >= self.v_max or (self.distributional and self.atoms < 2):
            raise ParameterError(
                f"{{v_min}}={self.v_min}, {{v_max}}={self.v_max}, {{atoms}}={self.atoms}: expected "
                "v_min below v_max and at least 2 atoms; widen the support."
            )
        if self.learning_rate_end is None and self.learning_rate_decisions > 0:
            raise ParameterError(
                f"{{learning_rate_decisions}}={self.learning_rate_decisions}: means nothing "
                "without {learning_rate_end}; give both or neither."
            )
        # the first batch is drawn from what the warm-up has filled
        if not self.batch_size <= self.warmup <= self.capacity:
            raise ParameterError(
                f"{{warmup}}={self.warmup}: expected at least {{batch_size}}={self.batch_size} and "
                f"at most {{capacity}}={self.capacity} transitions."
            )

    def for_phase(self, decisions: int) -> RainbowConfig:
        """The same for a phase of ``decisions``.

        The learning rate falls in that time unless it has a time of its own.
        """
        if self.learning_rate_end is not None and self.learning_rate_decisions == 0:
            return replace(self, learning_rate_decisions=decisions)
        return self
