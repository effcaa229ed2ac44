"""Rainbow's hyperparameters and switches."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ganlane.agents.network import NetworkConfig
from ganlane.errors import UserError

#: What must be at least 1.
COUNTS = (
    *("n_step", "atoms", "batch_size", "capacity", "decisions_per_update", "target_period"),
    *("encoder_width", "encoder_layers"),
)


@dataclass(frozen=True)
class RainbowConfig:
    """Hyperparameters; the values are for one update of 256 per 64 decisions.

    Switches: ``noisy, dueling, distributional, double, prioritised``, and ``n_step=1``. ``gamma`` is per decision.
    ``encoder, encoder_width, encoder_layers``: see :class:`~ganlane.agents.encoder.VehicleEncoder`;
    ``decide_when_free``: see :class:`~ganlane.agents.free_decisions.FreeDecisionWindow`.
    ``target_period`` and ``beta_updates`` count updates, ``epsilon_decisions`` decisions; epsilon is the share of
    random legal actions, drawn beside the noise (docs/agent.md). ``adam_eps=None`` stands for
    0.005 / ``batch_size``. The learning rate falls to ``learning_rate_end`` within ``learning_rate_decisions``, if an
    end is given. ``warmup`` is the number of transitions before the first update.
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
        for name in COUNTS:
            if getattr(self, name) < 1:
                raise UserError(f"agent.{name}={getattr(self, name)}: expected at least 1; give a positive number.")
        if not 0.0 < self.gamma <= 1.0:
            raise UserError(f"agent.gamma={self.gamma}: expected a discount above 0 and at most 1.")
        if self.v_min >= self.v_max or (self.distributional and self.atoms < 2):
            raise UserError(
                f"agent.v_min={self.v_min}, agent.v_max={self.v_max}, agent.atoms={self.atoms}: expected v_min below "
                "v_max and at least 2 atoms; widen the support."
            )
        if (self.learning_rate_end is None) != (self.learning_rate_decisions == 0):
            raise UserError(
                f"agent.learning_rate_end={self.learning_rate_end}, agent.learning_rate_decisions="
                f"{self.learning_rate_decisions}: one means nothing without the other; give both or neither."
            )
        if not self.batch_size <= self.warmup <= self.capacity:
            raise UserError(
                f"agent.warmup={self.warmup}: expected at least agent.batch_size={self.batch_size} and at most "
                f"agent.capacity={self.capacity} transitions."
            )

    def network(self, observation_size: int, actions: int) -> NetworkConfig:
        """The network's config for observations of size D and A actions."""
        shared = {f.name: getattr(self, f.name) for f in fields(NetworkConfig) if hasattr(self, f.name)}
        return NetworkConfig(observation_size=observation_size, actions=actions, **shared)
