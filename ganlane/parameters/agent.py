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
    one_of,
    optional,
)

#: What may stand before the noisy layers (:mod:`ganlane.agents.encoder`).
ENCODERS = ("none", "shared")
_DISCOUNT = Rule(lambda value: 0.0 < value <= 1.0, "a number above 0, at most 1")


@dataclass(frozen=True)
class RainbowConfig:
    """Hyperparameters of Rainbow (Hessel et al. 2018); the values are for one update of 256 per 64 decisions.

    Switches: ``noisy, dueling, distributional, double, prioritised``, and ``n_step=1``. ``gamma`` is per decision.
    ``encoder, encoder_width, encoder_layers``: see :class:`~ganlane.agents.encoder.VehicleEncoder`;
    ``decide_when_free``: see :class:`~ganlane.agents.free_decisions.FreeDecisionWindow`.
    ``target_period`` and ``beta_updates`` count updates, ``epsilon_decisions`` decisions; epsilon is the share of
    random legal actions, drawn beside the noise (docs/agent.md). ``adam_eps=None`` stands for
    0.005 / ``batch_size``. The learning rate falls to ``learning_rate_end``, if one is given, within
    ``learning_rate_decisions`` (0: those of the phase, :meth:`for_phase`). ``warmup`` is the number of transitions
    before the first update.
    """

    hidden: tuple[int, ...] = (256, 256)
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
        lists_to_tuples(self)
        counts = ["n_step", "batch_size", "capacity", "warmup", "decisions_per_update", "target_period", "atoms"]
        counts += ["encoder_width", "encoder_layers"]
        shares = ("alpha", "beta_start", "epsilon_start", "epsilon")
        check(
            self,
            hidden=every(at_least(1)),
            encoder=one_of(ENCODERS),
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
