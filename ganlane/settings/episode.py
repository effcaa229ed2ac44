"""An episode: its initial scene (Table II), the decision period of the ego, and its end."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

from ganlane.errors import ParameterError, UserError
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.record import Positive, PositiveRange, Range, Record, Share, up_to

#: What drives a decision: the tensor code, the native kernel, or the latter where it can.
KERNELS = ("torch", "native", "auto")

#: Positions are float32. After 60 s the median error, relative to a float64 run, is 0.002 m where a
#: drive starts at 5 km, 0.06 m at 100 km, 1.8 m at 1000 km.
FARTHEST_GOAL_M = 100_000.0
#: float32 counts physics steps up to 2**24, 1.7e6 s; far larger numbers overflow int64, and every
#: episode would end after one decision.
LATEST_TIMEOUT_S = 1_000_000.0
_GOAL = up_to(FARTHEST_GOAL_M, ", since positions are float32 and coarse beyond")
_TIMEOUT = up_to(LATEST_TIMEOUT_S, ", since physics steps are counted exactly up to there")


class Stream(IntEnum):
    """Disjoint sets of episodes.

    For training, for selection (validation), for reported results (test), and for ``ganlane
    benchmark``, on which no call and no command trains.
    """

    # the numbers enter the random keys: other ones would change every episode
    TRAIN = 0
    SELECT = 1
    REPORT = 2
    BENCHMARK = 3

    @classmethod
    def named(cls, name: str) -> Stream:
        """From its name in lower case.

        Raises:
            UserError: no such stream.
        """
        if name.upper() not in cls.__members__:
            names = ", ".join(cls.__members__).lower()
            raise UserError(f"stream={name}: expected one of {names}; choose one of them.")
        return cls[name.upper()]


@dataclass(frozen=True)
class EpisodeParameters(Record):
    """Decision period of the ego, distance to the goal and time limit; all above 0.

    Attributes:
        decision_period_s: a multiple of 0.1 s, the physics step.
        goal_m: distance from the start at which the episode ends with the goal's reward, m, at most
            100 km.
        timeout_s: time at which it is cut off, s, reported as time-out; at most 1e6 s.
    """

    # the ego decides once a second, the physics steps ten times
    decision_period_s: Positive = 1.0
    goal_m: Annotated[float, _GOAL] = 5000.0
    timeout_s: Annotated[float, _TIMEOUT] = 1000.0

    def __post_init__(self) -> None:
        super().__post_init__()
        # 0.3 / 0.1 is not exactly 3, so a whole number is tested with a tolerance.
        whole_s = self.substeps() * PHYSICS_STEP_S
        if whole_s == 0 or abs(whole_s - self.decision_period_s) > 1e-9:
            raise ParameterError(
                f"{{decision_period_s}}={self.decision_period_s:g} is not a multiple of "
                f"{PHYSICS_STEP_S:g} s; choose 0.1, 0.2, ... 1.0 or more."
            )

    def substeps(self) -> int:
        """Physics steps per decision."""
        return round(self.decision_period_s / PHYSICS_STEP_S)

    def most_decisions(self) -> int:
        """Decisions until the time limit."""
        # Floor division of the negative rounds up: a shorter last decision counts.
        return -(-round(self.timeout_s / PHYSICS_STEP_S) // self.substeps())


@dataclass(frozen=True)
class SpawnParameters(Record):
    """The first scene: Table II, extended by lorries. Distances in m, speeds in m/s, ranges (low,
    high).

    Desired speeds are above 0, since IDM divides by them. Whether so many vehicles fit and can
    brake is checked by :func:`ganlane.sim.spawn.check_start`.

    Attributes:
        spread_m: all vehicles start on this stretch.
        min_spacing_m: centre to centre in a lane, between cars; larger by the extra length of
            lorries (:attr:`spacing_m`).
        front_speed_mps: of vehicles ahead of the ego.
        rear_speed_mps: of vehicles behind it.
        ego_speed_mps: of the ego.
        desired_speed_mps: of the others.
        ego_desired_speed_mps: of the ego.
        length_m: of a car.
        width_m: of a car.
        truck_share: each of the others is a lorry with this probability, 0 to 1; the paper has
            none.
        truck_length_m: the longest rigid lorry of Directive 96/53/EC.
        truck_width_m: about its 2.55 m.
        truck_desired_speed_mps: 80 to 90 km/h, from Germany's limit for lorries to the speed
            limiter of Directive 92/6/EEC.
    """

    # where the first vehicles stand
    spread_m: Positive = 200.0
    min_spacing_m: Positive = 25.0
    # how fast they are at first, and want to be
    front_speed_mps: Range = (10.0, 12.0)
    rear_speed_mps: Range = (15.0, 25.0)
    ego_speed_mps: Range = (10.0, 15.0)
    desired_speed_mps: PositiveRange = (18.0, 26.0)
    ego_desired_speed_mps: Positive = 25.0
    # bodies; the paper has cars only
    length_m: Positive = 4.5
    width_m: Positive = 2.5
    truck_share: Share = 0.0
    truck_length_m: Positive = 12.0
    truck_width_m: Positive = 2.5
    truck_desired_speed_mps: PositiveRange = (22.0, 25.0)

    @property
    def longest_m(self) -> float:
        """Length of the longest possible vehicle, m."""
        return max(self.length_m, self.truck_length_m) if self.truck_share > 0 else self.length_m

    @property
    def widest_m(self) -> float:
        """Width of the widest possible vehicle, m."""
        return max(self.width_m, self.truck_width_m) if self.truck_share > 0 else self.width_m

    @property
    def spacing_m(self) -> float:
        """Minimum distance between centres in a lane, m.

        The gap between two lorries is that between two cars.
        """
        return self.min_spacing_m + (self.longest_m - self.length_m)

    def lane_capacity(self) -> int:
        """Vehicles that fit into one lane, whichever of them are lorries."""
        # The first vehicle needs no spacing before it.
        return int(self.spread_m / self.spacing_m) + 1

    def worst_followers(self) -> tuple[tuple[str, float, float, float], ...]:
        """Fastest followers.

        Key, highest speed, the leader's lowest speed, highest desired speed, m/s.
        """
        front, rear, ego = self.front_speed_mps, self.rear_speed_mps, self.ego_speed_mps
        others = self.desired_speed_mps[1]
        if self.truck_share > 0:
            others = max(others, self.truck_desired_speed_mps[1])
        # By group of followers: the fastest one behind the slowest leader that Table II allows.
        return (
            ("rear_speed_mps", rear[1], min(rear[0], ego[0], front[0]), others),
            ("ego_speed_mps", ego[1], front[0], self.ego_desired_speed_mps),
            ("front_speed_mps", front[1], front[0], others),
        )
