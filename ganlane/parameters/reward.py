"""The reward's numbers, section V.C of the paper."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane import keys
from ganlane.parameters.checks import at_most, below, check, number


@dataclass(frozen=True)
class RewardParameters:
    """Section V.C. Speeds in m/s, deceleration in m/s2; the other numbers are rewards.

    Attributes:
        base_speed_mps: the speed reward is 0 at this speed and 1 at the ego's desired speed, which is higher.
        low_acceleration: a mean acceleration below this, itself below 0, turns the speed reward against the agent.
        literal_low_acceleration: whether the speed reward is then negated, as the paper's text has it, which below
            15 m/s pays for crawling; by default its absolute value is.
        lane_change: when one starts.
        out_of_road: a command that would leave the road.
        hard_crash: a collision.
        soft_crash: per onset of somebody dangerously close ahead.
        goal: the goal reached.
        soft_crash_behind: per onset of a soft crash *behind* (:func:`ganlane.sim.ego.ego_surroundings`), at most 0.
            The paper has no such term; at 0 it is not there.
    """

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
        check(self, **limits, **dict.fromkeys(terms, number()))

    @property
    def term_names(self) -> tuple[str, ...]:
        """The terms in the order in which they are added up."""
        return keys.REWARD_TERM_NAMES + ((keys.SOFT_CRASH_BEHIND,) if self.soft_crash_behind else ())
