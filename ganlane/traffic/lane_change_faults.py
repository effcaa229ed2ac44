"""Faults of drivers across the road, as overlays: lane changes that are hesitant, and some that are broken off.

Both look at the target lane that the model below sets, and need one that moves towards
``vehicles.target_lane``, as every model that ships does.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.parameters.traffic import AbortFaults, HesitationFaults
from ganlane.sim.lanes import settled
from ganlane.sim.random import Purpose, Stream
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.faults import drawn, drivers
from ganlane.traffic.sequential import Overlay

#: Stands for 'no lane to turn back to'.
_NOWHERE = -1


def starting(vehicles: Vehicles, moved: Vehicles) -> Tensor:
    """Whose lane change the model below has just begun, bool [N, M]."""
    return (moved.target_lane != vehicles.target_lane) & drivers(vehicles)


class HesitantLaneChange(Overlay):
    """Some changes take longer: each step sideways is shortened to ``pace`` of it until the change is complete.

    Memory: whether the change under way is a ``hesitant`` one.
    """

    memory_fields = {"hesitant": ((), torch.bool)}  # noqa: RUF012

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, faults: HesitationFaults | None = None
    ) -> None:
        super().__init__(road, stream)
        self.faults = faults or HesitationFaults()

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """No change is under way."""
        return {"hesitant": torch.zeros_like(vehicles.valid)}

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        """Shorten the step sideways of the hesitant."""
        begins, u = starting(vehicles, moved), drawn(key, step, vehicles, Purpose.HESITANT_CHANGE)
        hesitant = torch.where(begins, u < self.faults.share, memory["hesitant"])
        slowed = vehicles.y + self.faults.pace * (moved.y - vehicles.y)
        moved = moved.with_(y=torch.where(hesitant, slowed, moved.y))
        return moved, {"hesitant": hesitant & ~settled(moved, self.road)}


class AbortedLaneChange(Overlay):
    """Some changes are broken off: on the way the driver turns back to the lane that he came from.

    At the default of half way the body is still in the old lane, where the others have seen it all the time, so its
    place there is free. Memory: the lane to turn back to (-1: none).
    """

    memory_fields = {"origin": ((), torch.int64)}  # noqa: RUF012

    def __init__(
        self, road: Road | None = None, stream: int = Stream.TRAIN, faults: AbortFaults | None = None
    ) -> None:
        super().__init__(road, stream)
        self.faults = faults or AbortFaults()

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> dict[str, Tensor]:
        """Nobody will turn back."""
        return {"origin": torch.full_like(vehicles.target_lane, _NOWHERE)}

    def rewrite(
        self, vehicles: Vehicles, moved: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor
    ) -> tuple[Vehicles, dict[str, Tensor]]:
        """Set the old lane as the target of those who have come far enough."""
        begins, u = starting(vehicles, moved), drawn(key, step, vehicles, Purpose.ABORTED_CHANGE)
        chosen = torch.where(u < self.faults.share, vehicles.target_lane, _NOWHERE)
        origin = torch.where(begins, chosen, memory["origin"])
        start, end = (self.road.centre_of(lane, moved.y.dtype) for lane in (origin, moved.target_lane))
        far_enough = (moved.y - start).abs() >= self.faults.at * (end - start).abs()
        turns = (origin != _NOWHERE) & far_enough
        moved = moved.with_(target_lane=torch.where(turns, origin, moved.target_lane))
        return moved, {"origin": torch.where(turns, _NOWHERE, origin)}
