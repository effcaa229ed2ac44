"""Decision period of the ego, and end of an episode."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S


@dataclass(frozen=True)
class EpisodeParameters:
    """Decision period of the ego, distance to the goal and time limit; s and m."""

    decision_period_s: float = 1.0
    goal_m: float = 5000.0
    timeout_s: float = 1000.0

    def substeps(self) -> int:
        """Physics steps per decision."""
        return round(self.decision_period_s / PHYSICS_STEP_S)

    def check(self) -> None:
        """Raise :class:`UserError` if the decision period is not a whole number of physics steps."""
        if self.substeps() < 1 or abs(self.substeps() * PHYSICS_STEP_S - self.decision_period_s) > 1e-9:
            raise UserError(
                f"env.decision_period_s={self.decision_period_s:g} is not a multiple of {PHYSICS_STEP_S:g} s; "
                "choose 0.1, 0.2, ... 1.0 or more."
            )
