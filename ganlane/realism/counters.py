"""Counts events while a traffic drives: overlaps, vehicles off the road, standstills, and a guard's interventions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import torch
from torch import Tensor

from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.lanes import lateral_half_extent
from ganlane.sim.neighbours import leader, perceive
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic import Guard, TrafficModule

#: A body further beyond the edge than this is off the road, m; less is rounding.
EDGE_M: Final = 0.01
#: A vehicle slower than this with a leader no nearer than that stands still without reason, m/s and m.
STANDING_MPS: Final = 1.0
FREE_M: Final = 50.0
#: Standstills are tested once in so many steps.
_SECOND: Final = 10
#: A guard intervenes where it alters more than this, m/s2 and m.
ALTERED_ACCELERATION: Final = 0.1
ALTERED_POSITION_M: Final = 0.02


class EventCounter:
    """Counts onsets; index 0 (the ego's) and vehicles that are not valid do not count.

    Attributes:
        overlaps: pairs of vehicles whose boxes began to overlap.
        off_road: vehicles whose body began to reach beyond the edge of the road.
        standstills: vehicles that began to stand still in free flow.
    """

    def __init__(self, road: Road) -> None:
        self.road = road
        self.overlaps = self.off_road = self.standstills = 0
        self._before: dict[str, Tensor] = {}

    def begin(self) -> None:
        """Forget the last state: a new batch of episodes begins."""
        self._before = {}

    def count(self, vehicles: Vehicles, step: int) -> None:
        """Count the events of a physics step."""
        others = vehicles.columns(slice(1, None))
        self.overlaps += self._onsets("overlap", pair_overlaps(others).triu(1))
        half = lateral_half_extent(others) - EDGE_M
        left, right = self.road.left_edge_m(), self.road.right_edge_m()
        outside = (others.y + half > left) | (others.y - half < right)
        self.off_road += self._onsets("off_road", outside & others.valid)
        if step % _SECOND == _SECOND - 1:
            self.standstills += self._onsets("standstill", self._standing(vehicles)[:, 1:])

    def _standing(self, vehicles: Vehicles) -> Tensor:
        slow = (vehicles.speed < STANDING_MPS) & vehicles.valid
        ahead = leader(perceive(vehicles, self.road), self.road.lane_of(vehicles.y))
        return slow & (ahead.gap > FREE_M)

    def _onsets(self, name: str, now: Tensor) -> int:
        """Number of entries that are true now and were not at the last count."""
        before = self._before.get(name, torch.zeros_like(now))
        self._before[name] = now
        return int((now & ~before).sum())


class GuardMeter:
    """Counts the vehicle-steps in which a guard alters acceleration or lateral position.

    A counter of one step's sums stays on the device; :attr:`share` fetches it.
    """

    def __init__(self) -> None:
        self._altered = torch.zeros((), dtype=torch.int64)
        self._steps = torch.zeros((), dtype=torch.int64)

    def __call__(self, before: Vehicles, moved: Vehicles, guarded: Vehicles) -> None:
        """Called by the guard at every step; index 0 is the ego's and does not count."""
        wanted = (moved.speed - before.speed) / PHYSICS_STEP_S
        given = (guarded.speed - before.speed) / PHYSICS_STEP_S
        along = (given - wanted).abs() > ALTERED_ACCELERATION
        across = (guarded.y - moved.y).abs() > ALTERED_POSITION_M
        counts = before.valid.clone()
        counts[:, 0] = False
        self._altered = self._altered + ((along | across) & counts).sum()
        self._steps = self._steps + counts.sum()

    @property
    def share(self) -> float | None:
        """Share of the vehicle-steps; None where no guard was at work."""
        steps = int(self._steps)
        return int(self._altered) / steps if steps else None


@contextmanager
def watched(traffic: TrafficModule, meter: GuardMeter) -> Iterator[None]:
    """Attach ``meter`` to every guard in ``traffic`` within the context."""
    guards = [part for part in traffic.modules() if isinstance(part, Guard)]
    before = [guard.observer for guard in guards]
    for guard in guards:
        guard.observer = meter
    try:
        yield
    finally:
        for guard, observer in zip(guards, before):
            guard.observer = observer
