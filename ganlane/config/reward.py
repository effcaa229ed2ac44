"""``reward=...``: what the agent is paid, section V.C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ganlane.config.checks import below, check, number
from ganlane.config.plain import plain_copy

if TYPE_CHECKING:
    from ganlane.transforms import RewardParameters


@dataclass
class RewardConfig:
    """``reward=paper``: section V.C (:class:`ganlane.transforms.RewardParameters`)."""

    base_speed_mps: float = 15.0
    low_acceleration: float = -2.0
    literal_low_acceleration: bool = False
    lane_change: float = -1.0
    out_of_road: float = -100.0
    hard_crash: float = -100.0
    soft_crash: float = -10.0
    goal: float = 100.0

    def __post_init__(self) -> None:
        terms = ("lane_change", "out_of_road", "hard_crash", "soft_crash", "goal", "base_speed_mps")
        check(self, "reward", low_acceleration=below(0), **dict.fromkeys(terms, number()))

    def parameters(self) -> RewardParameters:
        """As the transform takes it."""
        from ganlane.transforms import RewardParameters

        return plain_copy(self, RewardParameters)
