"""The road's lanes, and where each begins and ends.

Positions are those of the vehicles: x runs along the road and is 0 where the ego starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, NamedTuple

from ganlane.errors import ParameterError
from ganlane.settings.record import Number, Record, one_of

#: Stands for the beginning or end of a lane that has none, m.
FAR_M = 1e9
#: What is at the end of a lane.
NOTHING = "nothing"
WALL = "wall"
EXIT = "exit"
#: A driver that keeps a lane stops this far before its wall: the room that a standing car needs to
#: turn into the next lane, m.
TURN_OUT_M = 15.0


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


#: Of the lanes from the right to the left; empty: all lanes go on for ever.
Stretches = tuple[LaneStretch, ...]


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
    going_on = [lane for lane, its in enumerate(stretches) if its.end == NOTHING]
    for lane, its in enumerate(stretches):
        if goal is not None:
            away = abs(lane - goal)
            last = stretches[goal].end_m
        else:
            away = min(abs(lane - other) for other in going_on)
            last = its.end_m
        by_m.append(last if away else FAR_M)
        changes.append(float(max(away, 1)))
    return Leaving(tuple(by_m), tuple(changes))
