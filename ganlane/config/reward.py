"""``reward=...``: what the agent is paid, section V.C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ganlane.config.plain import plain_copy
from ganlane.errors import UserError
from ganlane.parameters.checks import at_most, below, check, number

if TYPE_CHECKING:
    from ganlane.config.env import EnvConfig
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
    soft_crash_behind: float = 0.0

    def __post_init__(self) -> None:
        terms = ("lane_change", "out_of_road", "hard_crash", "soft_crash", "goal", "base_speed_mps")
        limits = {"low_acceleration": below(0), "soft_crash_behind": at_most(0)}
        check(self, "reward", **limits, **dict.fromkeys(terms, number()))

    def parameters(self) -> RewardParameters:
        """As the transform takes it."""
        from ganlane.transforms import RewardParameters

        return plain_copy(self, RewardParameters)


@dataclass
class ConsiderateRewardConfig(RewardConfig):
    """``reward=considerate``: the paper's, and an onset of danger behind the ego costs what one ahead of it does."""

    soft_crash_behind: float = -10.0


def check_pay(env: EnvConfig, reward: RewardConfig) -> None:
    """The speed reward runs from 0 at its base speed to 1 at the ego's desired speed, so that must be the higher."""
    if env.ego_desired_speed_mps <= reward.base_speed_mps:
        raise UserError(
            f"env.ego_desired_speed_mps={env.ego_desired_speed_mps:g}: expected more than reward.base_speed_mps="
            f"{reward.base_speed_mps:g}, where the speed reward is 0; raise the one or lower the other."
        )
