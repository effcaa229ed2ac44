"""What the agent perceives, and which actions it may choose."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ganlane.errors import ParameterError
from ganlane.parameters.checks import above, assign, at_least, between, check, one_of, part_of
from ganlane.parameters.removed import refuse_removed_observation

#: How far a delay may be from a whole number of decisions, in decisions.
_TOLERANCE = 1e-6
#: What the agent can see, see :data:`ganlane.transforms.OBSERVATIONS`.
FORMS = (
    "table3",
    "table3_progress",
    "lane_view",
    "lane_view_drift",
    "lane_view_overlap",
    "table3_lane_view",
)
#: Scale of the nearness in the lane view, m.
NEARNESS_M = 15.0
#: Overlap along the road that adds 1 to the nearness, m: drivers at the side brake so hard that one metre decides.
OVERLAP_M = 1.0
#: The masks, see :class:`ganlane.transforms.ActionMaskTransform`.
MASKS = ("none", "legal", "safe")


@dataclass(frozen=True)
class ObservationScale:
    """What observations are divided by, above 0.

    Attributes:
        range_m: range of sight, m: relative positions are divided by it and clipped.
        speed_mps: the same for relative speeds, m/s; not a cap on driving.
    """

    range_m: float = 200.0
    speed_mps: float = 30.0

    def __post_init__(self) -> None:
        check(self, range_m=above(0), speed_mps=above(0))


@dataclass(frozen=True)
class SensorParameters:
    """Errors in what the ego perceives of the other vehicles; all at least 0, all 0: none.

    Attributes:
        position_noise_m: standard deviation of a Gaussian error along the road, m, drawn anew for every vehicle and
            decision.
        lateral_noise_m: the same across the road, m.
        speed_noise_mps: the same of the speed, m/s.
        dropout: probability that a vehicle is not seen in a decision.
        delay_s: age of what is perceived, s, a multiple of env.decision_period_s.
    """

    position_noise_m: float = 0.0
    lateral_noise_m: float = 0.0
    speed_noise_mps: float = 0.0
    dropout: float = 0.0
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        sizes = ("position_noise_m", "lateral_noise_m", "speed_noise_mps", "delay_s")
        check(self, dropout=between(0, 1), **dict.fromkeys(sizes, at_least(0)))

    def delay_decisions(self, decision_period_s: float) -> int:
        """The delay in decisions.

        Raises:
            ParameterError: it is not a whole number of them.
        """
        decisions = self.delay_s / decision_period_s
        if abs(decisions - round(decisions)) > _TOLERANCE:
            raise ParameterError(
                f"{{delay_s}}={self.delay_s:g}: expected a multiple of the decision period "
                f"({decision_period_s:g} s), since the ego measures once per decision; change one of them."
            )
        return round(decisions)


@dataclass(frozen=True)
class ObservationConfig(ObservationScale):
    """``observation=lane_view_overlap`` and the other forms (:class:`ganlane.transforms.ObservationTransform`).

    Attributes:
        form: one of :data:`FORMS`.
        sensors: errors in what the ego perceives of the others; None, and all 0: none.
    """

    form: str = "lane_view_overlap"
    sensors: SensorParameters | None = field(default_factory=SensorParameters)

    def __post_init__(self) -> None:
        super().__post_init__()
        # One way to say that there are no errors, which is also that of older runs.
        if self.sensors == SensorParameters():
            assign(self, sensors=None)
        refuse_removed_observation(self.form)
        check(self, form=one_of(FORMS))

    def scale(self) -> ObservationScale:
        """The normalisers alone."""
        return part_of(self, ObservationScale)

    def read_by(self, agent: ObservationConfig | None) -> ObservationConfig:
        """What a driver reads here: the form and scale that ``agent`` names, if it does, through these sensors."""
        return self if agent is None else replace(agent, sensors=self.sensors)


def largest_number(form: str, longest_m: float = 4.5) -> float:
    """Upper bound of all numbers of observation ``form`` but the first (speed over desired speed, unbounded).

    ``longest_m`` is the length of the longest vehicle, m: ``lane_view_overlap`` counts metres of overlap.
    """
    return 1.0 + longest_m / OVERLAP_M if form == "lane_view_overlap" else 1.0


@dataclass(frozen=True)
class MaskParameters:
    """Which actions the driver of the ego may choose.

    Attributes:
        form: one of :data:`MASKS`; ``none`` is the paper's literal form.
        safe_deceleration: MOBIL's ``b_safe``, m/s2, above 0; read by ``safe`` alone.
    """

    form: str = "none"
    safe_deceleration: float = 4.0

    def __post_init__(self) -> None:
        check(self, form=one_of(MASKS), safe_deceleration=above(0))
