"""The road's lanes, where each begins and ends, and who enters and leaves.

Positions are those of the vehicles: x runs along the road and is 0 where the ego starts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, NamedTuple

from ganlane.errors import ParameterError
from ganlane.settings.record import NotNegative, Number, Record, Share, between, one_of

#: Stands for the beginning or end of a lane that has none, m.
FAR_M = 1e9
#: What is at the end of a lane.
NOTHING = "nothing"
WALL = "wall"
EXIT = "exit"
#: A driver that keeps a lane stops this far before its wall: the room that a standing car needs to
#: turn into the next lane, m.
TURN_OUT_M = 15.0
#: Of those who have to leave their lane so urgently, others make room: the share of the urgency at
#: the end itself (Schakel, Knoop and van Arem 2012).
ASKS_FROM = 0.577


@dataclass(frozen=True)
class LaneStretch(Record):
    """The stretch of the road on which there is a lane.

    Before its beginning and behind its exit a lane is a ramp: it is driven on, but nobody changes
    into it or out of it there.

    Attributes:
        begin_m: where it begins, m; by default far behind.
        end_m: where it ends, m; by default far ahead.
        end: what is there: ``wall``, which nobody may touch; ``exit``, where the lane leaves the
            road; ``nothing`` for a lane that goes on.
    """

    begin_m: Number = -FAR_M
    end_m: Number = FAR_M
    end: Annotated[str, one_of((NOTHING, WALL, EXIT))] = NOTHING

    def __post_init__(self) -> None:
        super().__post_init__()
        if not -FAR_M <= self.begin_m < self.end_m <= FAR_M:
            raise ParameterError(
                f"{{end_m}}={self.end_m:g}: expected more than {{begin_m}}={self.begin_m:g}, both "
                f"within {FAR_M:g} m."
            )
        if (self.end == NOTHING) != (self.end_m == FAR_M):
            raise ParameterError(
                f"{{end}}={self.end}: expected wall or exit where the lane has an end, and nothing "
                "where it has none."
            )

    def seen_from(self, start_m: float) -> LaneStretch:
        """The same stretch where positions are counted from ``start_m`` on."""
        begin_m = self.begin_m if self.begin_m == -FAR_M else self.begin_m - start_m
        end_m = self.end_m if self.end_m == FAR_M else self.end_m - start_m
        return LaneStretch(begin_m, end_m, self.end)


#: Of the lanes from the right to the left; empty: all lanes go on for ever.
Stretches = tuple[LaneStretch, ...]


def with_side_lane(lanes: int, begin_m: float, length_m: float, end: str) -> Stretches:
    """The rightmost of the ``lanes`` begins and ends, the others go on."""
    side = LaneStretch(begin_m, begin_m + length_m, end)
    return (side, *[LaneStretch()] * (lanes - 1))


def exit_lane(stretches: Stretches) -> int | None:
    """The lane that ends in an exit; None without one."""
    return next((lane for lane, its in enumerate(stretches) if its.end == EXIT), None)


class Leaving(NamedTuple):
    """Of every lane: where a driver has to have left it, m, and by how many lane changes.

    :data:`FAR_M` and 1 for a lane that the driver may stay in.
    """

    by_m: tuple[float, ...]
    changes: tuple[float, ...]


@lru_cache(maxsize=256)
def leaving(stretches: Stretches, goal: int | None = None) -> Leaving:
    """The lanes that a driver has to leave.

    Args:
        stretches: of all lanes; one of them goes on.
        goal: the exit lane that the driver wants to reach; None: it stays on the road.
    """
    by_m = []
    changes = []
    goals = [lane for lane, its in enumerate(stretches) if its.end == NOTHING]
    if goal is not None:
        goals = [goal]
    for lane, its in enumerate(stretches):
        away = min(abs(lane - other) for other in goals)
        last = its if goal is None else stretches[goal]
        by_m.append(last.end_m if away else FAR_M)
        changes.append(float(max(away, 1)))
    return Leaving(tuple(by_m), tuple(changes))


@dataclass(frozen=True)
class FlowParameters(Record):
    """Vehicles that enter a section of the road and leave it, in a fixed number of slots.

    A vehicle that has passed the end of the section, or of the exit lane, has left: it waits
    outside. Vehicles arrive at random at the section's beginning, in every lane on its own; one
    that would make anybody brake hard, or for which nobody waits, is turned away.

    Attributes:
        vph: that arrive in each lane of the road, veh/h.
        ramp_vph: and in each lane that begins within the section, an on-ramp, veh/h.
        exit_share: of the drivers, who leave the road by its exit.
        from_m: beginning of the section, m; the ego starts at 0.
        to_m: its end, m, behind the ends of all lanes.
        slots: vehicles that wait outside at the start, beside those of the scene, 0 to 900.
    """

    vph: NotNegative = 0.0
    ramp_vph: NotNegative = 0.0
    exit_share: Share = 0.0
    from_m: Number = -300.0
    to_m: Number = 1300.0
    slots: Annotated[int, between(0, 900)] = 60

    @property
    def is_on(self) -> bool:
        """Whether anybody arrives, or leaves by the exit."""
        return self.vph > 0 or self.ramp_vph > 0 or self.exit_share > 0

    def arrivals(self, stretches: Stretches, period_s: float) -> tuple[float, ...]:
        """The probability of an arrival within ``period_s``, of each lane."""
        rates = [self.ramp_vph if its.begin_m > self.from_m else self.vph for its in stretches]
        return tuple(rate * period_s / 3600.0 for rate in rates)

    def exits(self, vehicles: int) -> tuple[bool, ...]:
        """Whether the driver of each slot leaves by the exit: the ego, whose mission it is, and the
        share of the others, as evenly as it can be.
        """
        leave = [math.floor(slot * self.exit_share) for slot in range(vehicles)]
        return (True, *(leave[slot] > leave[slot - 1] for slot in range(1, vehicles)))

    def check(self, stretches: Stretches, period_s: float) -> None:
        """Raise :class:`ParameterError` for a section that does not fit the road, or more vehicles
        than can arrive.
        """
        last_m = max((its.end_m for its in stretches if its.end != NOTHING), default=-FAR_M)
        first_m = min(its.end_m for its in stretches)
        if not (self.from_m < min(first_m, 0.0) and max(last_m, 0.0) < self.to_m):
            raise ParameterError(
                f"{{from_m}}={self.from_m:g}, {{to_m}}={self.to_m:g}: expected a section around "
                f"the ego's start and the ends of all lanes, from below {min(first_m, 0.0):g} m to "
                f"above {max(last_m, 0.0):g} m."
            )
        if self.exit_share > 0 and exit_lane(stretches) is None:
            raise ParameterError(
                f"{{exit_share}}={self.exit_share:g}: the road has no exit; leave it out, or take "
                "env=weave or env=exit."
            )
        for name in ("vph", "ramp_vph"):
            if getattr(self, name) * period_s > 3600.0:
                raise ParameterError(
                    f"{{{name}}}={getattr(self, name):g}: expected at most {3600.0 / period_s:g}, "
                    "one vehicle in a decision."
                )
