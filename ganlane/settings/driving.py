"""Who drives and how: car following and lane changes (Tables IV and V), the ego, and the traffics'
own drivers.

The latter are generated, random, faulty and recorded ones, and those of SUMO.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.record import (
    Negative,
    NotNegative,
    Positive,
    PositiveRange,
    PositiveShare,
    Range,
    Record,
    Rule,
    Share,
    at_least,
    between,
    one_of,
)


class Visibility(IntEnum):
    """When others see a vehicle that enters their lane; see :mod:`ganlane.sim.state`."""

    # in the order of how early others see a change; stored in states, so never renumbered
    CENTRE = 0
    BODY = 1
    SIGNALLED = 2

    @classmethod
    def named(cls, name: str) -> Visibility:
        """From its name in lower case, as on the command line."""
        return cls[name.upper()]


@dataclass(frozen=True)
class IdmParameters(Record):
    """The Intelligent Driver Model (Treiber et al. 2000) with the paper's Table V.

    The acceleration exponent is 4, computed as two squarings: the result of ``torch.pow`` may
    differ in its last bits between batch sizes.

    Attributes:
        min_gap_m: gap to a standing leader, m, at least 0.
        headway_s: time headway, s, at least 0.
        comfortable_deceleration: m/s2, above 0.
        min_acceleration: the hardest braking, m/s2, below 0.
        max_acceleration: m/s2, above 0.
    """

    # Table V
    min_gap_m: NotNegative = 2.0
    headway_s: NotNegative = 1.6
    comfortable_deceleration: Positive = 1.7
    min_acceleration: Negative = -20.0
    max_acceleration: Positive = 0.7

    def per_lane(self) -> IdmParameters:
        """The parameters, which broadcast to lanes and pairs."""
        return self

    def brake_scale(self) -> float:
        """``2 sqrt(a b)`` of the approach term, m/s2."""
        # a: the largest acceleration, b: the comfortable deceleration
        return 2.0 * math.sqrt(self.max_acceleration * self.comfortable_deceleration)


@dataclass(frozen=True)
class MobilParameters(Record):
    """The lane-changing model MOBIL (Kesting et al. 2007) with the paper's Table IV; all at least
    0.

    Attributes:
        threshold: least incentive for a change, m/s2.
        politeness_rear: ``q``, weights the old ('rear') follower.
        politeness_side: ``p``, weights the new ('side') one.
        safe_deceleration: a change may not make any vehicle brake harder, m/s2, above 0.
        exclusive_m: of several vehicles that want to enter one lane within this distance, only the
            foremost does, m.
        mandatory_bias: what the end of a lane that a driver has to leave adds to the incentive, at
            the end itself, m/s2; twice the safe deceleration outweighs what two drivers may lose by
            a safe change. The paper's road has no such lane.
        mandatory_m: distance from the end at which that begins, m per lane change that the driver
            has to make; 295 in Schakel, Knoop and van Arem (2012). Exits are announced 500 and
            1000 m ahead on German motorways.
        courtesy: where lanes end, the deceleration with which a driver makes room for one ahead
            beside it who has to leave its lane, and with which one who has to falls behind whoever
            blocks it (the ego behind followers, too), m/s2; 0: none does. About IDM's comfortable
            one, as in Schakel, Knoop and van Arem (2012).
    """

    # Table IV
    threshold: NotNegative = 0.1
    politeness_rear: NotNegative = 0.5
    politeness_side: NotNegative = 1.0
    safe_deceleration: Positive = 4.0
    exclusive_m: NotNegative = 60.0
    # where lanes end
    mandatory_bias: NotNegative = 8.0
    mandatory_m: Positive = 500.0
    courtesy: NotNegative = 2.0


@dataclass(frozen=True)
class EgoParameters(Record):
    """How the ego handles commands and when others see its lane changes.

    Attributes:
        abort_lane_change: whether the opposite command turns back the current lane change.
        visibility: when others see its lane changes: centre, body, signalled.
        soft_crash_ttc_s: a time to collision below this is a soft crash, s, at least 0.
        soft_crash_gap_m: and so is a gap below this, m, at least 0.
    """

    # commands, and when others see them
    abort_lane_change: bool = False
    visibility: Annotated[str, one_of(kind.name.lower() for kind in Visibility)] = "body"
    # what counts as dangerously close
    soft_crash_ttc_s: NotNegative = 1.5
    soft_crash_gap_m: NotNegative = 2.0


@dataclass(frozen=True)
class SteeringParameters:
    # seconds, not metres: both points move out with the speed
    """Look-ahead times (s), gains (each divided by speed, times the wheelbase) and limits."""

    near_s: float = 1.0
    far_s: float = 4.0
    # stable in steps of 0.1 s, without overshoot (ganlane.sim.dynamics)
    gain_far: float = 1.5
    gain_near: float = 3.0
    gain_integral: float = 3.375
    #: Below this speed the law is one of distance travelled, not of time: a standing car does not
    #: turn its wheels.
    slow_mps: float = 3.0
    max_angle_rad: float = 0.5


#: A time that lasts a physics step at least, s.
Steps = Annotated[float, at_least(PHYSICS_STEP_S)]


@dataclass(frozen=True)
class RandomDrivers(Record):
    """Ranges (low, high) that every driver's parameters are drawn from, uniformly and
    independently, per episode.

    Attributes:
        headway_s: IDM's time headway T, s. The recorded followers' middle half on US-101 keeps 0.93
            to 1.93 s (median 1.27); Kesting and Treiber (2008) fit 1.2 to 1.5 s, Treiber and
            Kesting (2013, table 11.2) take 1.0 s on highways.
        max_acceleration: m/s2; 1.0 there, Table V has 0.7, calibrations on trajectories give up to
            about 1.5.
        comfortable_deceleration: m/s2; 1.5 there, Table V has 1.7.
        strongest_braking: m/s2, more only where the first scene asks for it
            (:func:`ganlane.traffic.idm_mobil.start_braking`). About 9 is what dry asphalt allows, 4
            is a hesitant driver or a wet road.
        desired_speed: factor on the desired speed that the scene gives (Table II: 18 to 26 m/s).
        politeness: factor on MOBIL's weights of the followers (Table IV), 0 is an egoist.
        reaction_s: time that passes before an acceleration decided on is driven, s. Drivers'
            reaction times of about 1 s are partly made up for by anticipation (Treiber, Kesting and
            Helbing 2006), which IDM has none of, so the range lies below them.
        sway_m: how far the line that a driver aims at wanders from its lane's centre, m; less in
            narrow lanes.
        sway_period_s: periods of that wandering, s.
    """

    # car following
    headway_s: Range = (0.8, 2.2)
    max_acceleration: PositiveRange = (0.6, 1.6)
    comfortable_deceleration: PositiveRange = (1.2, 2.5)
    strongest_braking: PositiveRange = (4.0, 9.0)
    desired_speed: PositiveRange = (0.9, 1.1)
    # lane changes, and what a driver cannot do exactly
    politeness: Range = (0.0, 1.0)
    reaction_s: Annotated[
        Range, Rule(lambda value: value[1] <= 3, "two numbers [low, high], 0 <= low <= high <= 3")
    ] = (0.0, 0.6)
    sway_m: Range = (0.0, 0.25)
    sway_period_s: PositiveRange = (8.0, 20.0)


@dataclass(frozen=True)
class BrakingFaults(Record):
    """Phantom braking.

    Attributes:
        per_hour: how often, per driver and hour of driving without it; 0: never.
        deceleration: how hard, m/s2; a driver who brakes harder anyway is not changed.
        lasts_s: how long, s.
    """

    per_hour: NotNegative = 6.0
    deceleration: Positive = 4.0
    lasts_s: Steps = 1.0


@dataclass(frozen=True)
class ReactionFaults(Record):
    """Late reactions.

    Attributes:
        per_hour: lapses of attention per driver and hour of driving with attention; 0: never.
        delay_s: how late the driver reacts meanwhile, s, at least one physics step.
        lasts_s: how long a lapse lasts, s.
    """

    per_hour: NotNegative = 12.0
    delay_s: Steps = 0.8
    lasts_s: Steps = 5.0


@dataclass(frozen=True)
class HesitationFaults(Record):
    """Hesitant lane changes.

    Attributes:
        share: of the lane changes, 0 to 1.
        pace: their lateral speed over the usual one, above 0 to 1.
    """

    share: Share = 0.2
    pace: PositiveShare = 0.5


@dataclass(frozen=True)
class AbortFaults(Record):
    """Aborted lane changes.

    Attributes:
        share: of the lane changes, 0 to 1.
        at: how far the change has come when the driver turns back, 0 to 1; 0.5 is the line between
            the lanes.
    """

    share: Share = 0.1
    at: Share = 0.5


@dataclass(frozen=True)
class HumanVariation(Record):
    """How drivers of ``human`` differ from those recorded, one property each.

    For experiments on what an agent learns from which property of traffic (docs/drivers.md).

    Attributes:
        temperature: of the distributions along and across; 1 as fitted, lower is calmer.
        lane_changes: factor of the probability to begin a lane change; with 1 drivers change lanes
            as often a second as recorded ones (0.012, US-101).
        politeness: factor of the braking that a lane change would ask of the driver behind, as the
            driver takes it to be: 0, and it does not count.
        delayed: decisions of 0.4 s by which accelerations come late.
    """

    temperature: Annotated[float, between(0.1, 2)] = 0.8
    lane_changes: Annotated[float, between(0, 10)] = 1.0
    politeness: Annotated[float, between(0, 10)] = 1.0
    delayed: Annotated[int, between(0, 4)] = 0


@dataclass(frozen=True)
class DriverFaults(Record):
    """How often drivers make which faults; a rate or share of 0 switches one off.

    Attributes:
        phantom_braking: a driver brakes for nothing.
        late_reaction: a driver accelerates and brakes too late for a while.
        hesitant_change: a lane change takes longer.
        aborted_change: a driver turns back during a lane change.
    """

    phantom_braking: BrakingFaults = BrakingFaults()
    late_reaction: ReactionFaults = ReactionFaults()
    hesitant_change: HesitationFaults = HesitationFaults()
    aborted_change: AbortFaults = AbortFaults()
