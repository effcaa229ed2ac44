"""What a run is told, and what it tells."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ganlane.errors import UserError


@dataclass(frozen=True)
class TrainingConfig:
    """Length and rhythm of a run. ``*_every`` count decisions over all environments; 0 is never.

    A checkpoint is written ``checkpoint_every_s`` seconds after the last one, later if writing takes long: never
    more than 2 % of the time. ``checkpoint_replay`` includes the replay buffer, without which a resumed run has to
    fill it again and is not bit-exact. ``best_metric`` is the figure of the evaluation by which the best agent is
    kept. ``progress`` shows a bar on a terminal and lines elsewhere.
    """

    total_decisions: int
    log_every: int = 20_000
    evaluate_every: int = 0
    best_metric: str = "mean_reward"
    checkpoint_every_s: float = 20.0
    checkpoint_replay: bool = True
    progress: bool = True

    def __post_init__(self) -> None:
        for name, least in (("total_decisions", 1), ("log_every", 1), ("evaluate_every", 0)):
            if getattr(self, name) < least:
                raise UserError(f"{name}={getattr(self, name)}: expected at least {least}.")
        if self.checkpoint_every_s < 0.0:
            raise UserError(f"checkpoint_every_s={self.checkpoint_every_s}: expected seconds, 0 or more.")


@dataclass(frozen=True)
class TrainingResult:
    """How a run ended.

    ``stopped_by`` is the number of the signal that stopped it early, or None; an entry point then exits with 128
    more. ``best`` is the best evaluation's ``best_metric``. ``checkpoint`` is where to resume from.
    """

    decisions: int
    updates: int
    wall_s: float
    best: float | None
    stopped_by: int | None
    checkpoint: Path
