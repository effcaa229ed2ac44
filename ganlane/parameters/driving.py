"""How drivers follow and change lanes: Tables IV and V, and what is special about the ego."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

from ganlane.parameters.checks import NotNegative, Positive, Record, below, one_of


class Visibility(IntEnum):
    """When others see a vehicle that enters their lane; see :mod:`ganlane.sim.state`."""

    CENTRE = 0
    BODY = 1
    SIGNALLED = 2

    @classmethod
    def named(cls, name: str) -> Visibility:
        """From its name in lower case, as on the command line."""
        return cls[name.upper()]


VISIBILITIES = tuple(kind.name.lower() for kind in Visibility)


@dataclass(frozen=True)
class IdmParameters(Record):
    """The Intelligent Driver Model (Treiber et al. 2000) with the paper's Table V.

    The acceleration exponent is 4, computed as two squarings: the result of ``torch.pow`` may differ in its last bits
    between batch sizes.

    Attributes:
        min_gap_m: gap to a standing leader, m, at least 0.
        headway_s: time headway, s, at least 0.
        comfortable_deceleration: m/s2, above 0.
        min_acceleration: the hardest braking, m/s2, below 0.
        max_acceleration: m/s2, above 0.
    """

    min_gap_m: NotNegative = 2.0
    headway_s: NotNegative = 1.6
    comfortable_deceleration: Positive = 1.7
    min_acceleration: Annotated[float, below(0)] = -20.0
    max_acceleration: Positive = 0.7

    def per_lane(self) -> IdmParameters:
        """The parameters, which broadcast to lanes and pairs."""
        return self

    def brake_scale(self) -> float:
        """``2 sqrt(a b)`` of the approach term, m/s2."""
        return 2.0 * math.sqrt(self.max_acceleration * self.comfortable_deceleration)


@dataclass(frozen=True)
class MobilParameters(Record):
    """The lane-changing model MOBIL (Kesting et al. 2007) with the paper's Table IV; all at least 0.

    Attributes:
        threshold: least incentive for a change, m/s2.
        politeness_rear: ``q``, weights the old ('rear') follower.
        politeness_side: ``p``, weights the new ('side') one.
        safe_deceleration: a change may not make any vehicle brake harder, m/s2, above 0.
        exclusive_m: of several vehicles that want to enter one lane within this distance, only the foremost does, m.
    """

    threshold: NotNegative = 0.1
    politeness_rear: NotNegative = 0.5
    politeness_side: NotNegative = 1.0
    safe_deceleration: Positive = 4.0
    exclusive_m: NotNegative = 60.0


@dataclass(frozen=True)
class EgoParameters(Record):
    """How the ego handles commands and when others see its lane changes.

    Attributes:
        abort_lane_change: whether the opposite command turns back the current lane change.
        visibility: when others see its lane changes: centre, body, signalled.
        soft_crash_ttc_s: a time to collision below this is a soft crash, s, at least 0.
        soft_crash_gap_m: and so is a gap below this, m, at least 0.
    """

    abort_lane_change: bool = False
    visibility: Annotated[str, one_of(VISIBILITIES)] = "body"
    soft_crash_ttc_s: NotNegative = 1.5
    soft_crash_gap_m: NotNegative = 2.0


@dataclass(frozen=True)
class SteeringParameters:
    """Look-ahead times (s), gains (each divided by speed, times the wheelbase) and limits."""

    near_s: float = 1.0
    far_s: float = 4.0
    gain_far: float = 1.5
    gain_near: float = 3.0
    gain_integral: float = 3.375
    #: Below this speed the law is one of distance travelled, not of time: a standing car does not turn its wheels.
    slow_mps: float = 3.0
    max_angle_rad: float = 0.5
