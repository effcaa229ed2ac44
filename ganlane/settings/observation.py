"""What the agent perceives, which actions it may choose, and what it is rewarded for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from ganlane import keys
from ganlane.errors import ParameterError
from ganlane.settings.record import (
    Negative,
    NotNegative,
    NotPositive,
    Number,
    Positive,
    Record,
    Share,
    assign,
    one_of,
    option_names,
    part_of,
)

#: What the agent can see, one option each; see :data:`ganlane.transforms.OBSERVATIONS`.
FORMS = tuple(option_names("observation"))
#: Scale of the nearness in the lane view, m.
NEARNESS_M = 15.0
#: Overlap along the road that adds 1 to the nearness, m: drivers at the side brake so hard that one
#: metre decides.
OVERLAP_M = 1.0
#: How far the ego knows the lanes ahead, m.
ROAD_SIGHT_M = 1000.0
#: The masks, in the order of step.cpp's numbers ``MASK_ROAD, MASK_LEGAL, ...``; see
#: :class:`ganlane.transforms.ActionMaskTransform`.
MASKS = ("none", "legal", "safe", "foresight")


@dataclass(frozen=True)
class ObservationScale(Record):
    """What observations are divided by, above 0.

    Attributes:
        range_m: range of sight, m: relative positions are divided by it and clipped.
        speed_mps: the same for relative speeds, m/s; not a cap on driving.
    """

    range_m: Positive = 200.0
    speed_mps: Positive = 30.0


@dataclass(frozen=True)
class SensorParameters(Record):
    """Errors in what the ego perceives of the other vehicles; all at least 0, all 0: none.

    Attributes:
        position_noise_m: standard deviation of a Gaussian error along the road, m, drawn anew for
            every vehicle and decision.
        lateral_noise_m: the same across the road, m.
        speed_noise_mps: the same of the speed, m/s.
        dropout: probability that a vehicle is not seen in a decision.
        delay_s: age of what is perceived, s, a multiple of env.decision_period_s.
    """

    # what a measurement gets wrong, and how late it comes
    position_noise_m: NotNegative = 0.0
    lateral_noise_m: NotNegative = 0.0
    speed_noise_mps: NotNegative = 0.0
    dropout: Share = 0.0
    delay_s: NotNegative = 0.0

    def delay_decisions(self, decision_period_s: float) -> int:
        """The delay in decisions; :class:`ParameterError` unless that is a whole number."""
        decisions = self.delay_s / decision_period_s
        # 0.3 / 0.1 is not exactly 3, so a whole number is tested with a tolerance.
        if abs(decisions - round(decisions)) > 1e-6:
            raise ParameterError(
                f"{{delay_s}}={self.delay_s:g}: expected a multiple of the decision period "
                f"({decision_period_s:g} s), since the ego measures once per decision; change one "
                "of them."
            )
        return round(decisions)


@dataclass(frozen=True)
class ObservationConfig(ObservationScale):
    """``observation=lane_view_overlap`` and the other forms
    (:class:`ganlane.transforms.ObservationTransform`).

    Attributes:
        form: one of :data:`FORMS`.
        sensors: errors in what the ego perceives of the others; None, and all 0: none.
    """

    group = "observation"

    form: Annotated[str, one_of(FORMS)] = "lane_view_overlap"
    sensors: SensorParameters | None = SensorParameters()

    def __post_init__(self) -> None:
        super().__post_init__()
        # One way to say that there are no errors.
        if self.sensors == SensorParameters():
            assign(self, sensors=None)

    def scale(self) -> ObservationScale:
        """The normalisers alone."""
        return part_of(self, ObservationScale)

    def read_by(self, agent: ObservationConfig | None) -> ObservationConfig:
        """What a driver reads here.

        The form and scale that ``agent`` names, if it does, through these sensors.
        """
        return self if agent is None else replace(agent, sensors=self.sensors)


def largest_number(form: str, longest_m: float = 4.5) -> float:
    """Upper bound of all numbers of observation ``form`` but the first (speed over desired speed,
    unbounded).

    ``longest_m`` is the length of the longest vehicle, m: ``lane_view_overlap`` and ``road_view``
    count metres of overlap.
    """
    counts_overlap = form in ("lane_view_overlap", "road_view")
    return 1.0 + longest_m / OVERLAP_M if counts_overlap else 1.0


@dataclass(frozen=True)
class MaskParameters(Record):
    """Which actions the driver of the ego may choose.

    Attributes:
        form: one of :data:`MASKS`; ``none`` is the paper's literal form.
        safe_deceleration: MOBIL's ``b_safe``, m/s2, above 0; read by ``safe`` and ``foresight``.
    """

    group = "mask"

    form: Annotated[str, one_of(MASKS)] = "none"
    safe_deceleration: Positive = 4.0


@dataclass(frozen=True)
class RewardParameters(Record):
    """Section V.C. Speeds in m/s, deceleration in m/s2; the other numbers are rewards.

    Attributes:
        base_speed_mps: the speed reward is 0 at this speed and 1 at the ego's desired speed, which
            is higher.
        low_acceleration: a mean acceleration below this, itself below 0, turns the speed reward
            against the agent.
        literal_low_acceleration: whether the speed reward is then negated, as the paper's text has
            it, which below 15 m/s pays for crawling; by default its absolute value is.
        lane_change: when one starts.
        out_of_road: a command that would leave the road.
        hard_crash: a collision.
        soft_crash: per onset of somebody dangerously close ahead.
        goal: the goal reached.
        soft_crash_behind: per onset of a soft crash *behind*
            (:func:`ganlane.sim.dynamics.ego_surroundings`), at most
            0. The paper has no such term; at 0 it is not there.
    """

    group = "reward"

    # what is paid for speed
    base_speed_mps: Number = 15.0
    low_acceleration: Negative = -2.0
    literal_low_acceleration: bool = False
    # what an event costs or earns
    lane_change: Number = -1.0
    out_of_road: Number = -100.0
    hard_crash: Number = -100.0
    soft_crash: Number = -10.0
    goal: Number = 100.0
    soft_crash_behind: NotPositive = 0.0

    @property
    def term_names(self) -> tuple[str, ...]:
        """The terms in the order in which they are added up."""
        return keys.REWARD_TERM_NAMES + (
            (keys.SOFT_CRASH_BEHIND,) if self.soft_crash_behind else ()
        )
