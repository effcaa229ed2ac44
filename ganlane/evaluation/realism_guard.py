"""How much of the driving is the guard's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import torch

from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic import Guard, TrafficModule

#: Less than this is no intervention, m/s2 and m.
ALTERED_ACCELERATION: Final = 0.1
ALTERED_POSITION_M: Final = 0.02


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
    """Let ``meter`` see every guard in ``traffic``, for as long as the context lasts."""
    guards = [part for part in traffic.modules() if isinstance(part, Guard)]
    before = [guard.observer for guard in guards]
    for guard in guards:
        guard.observer = meter
    try:
        yield
    finally:
        for guard, observer in zip(guards, before):
            guard.observer = observer
