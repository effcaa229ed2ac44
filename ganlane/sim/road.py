"""The road: a number of parallel lanes, straight, optionally closed to a ring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Road:
    """Lane 0 is the rightmost; the centre of lane k lies at ``y = k * lane_width_m``.

    ``lanes`` and ``lane_width_m`` may be tensors [N, 1] if every environment has its own road
    (recorded scenes). ``ring_m`` closes the road to a ring of that length: positions stay unwrapped, only
    distances between vehicles are taken modulo the ring.
    """

    lanes: int | Tensor = 3
    lane_width_m: float | Tensor = 4.0
    ring_m: float | None = None

    def clamp_lane(self, lane: Tensor) -> Tensor:
        """``lane`` limited to the road."""
        if isinstance(self.lanes, Tensor):
            return torch.minimum(lane.clamp_min(0), (self.lanes - 1).to(lane.dtype))
        return lane.clamp(0, self.lanes - 1)

    def lane_of(self, y: Tensor) -> Tensor:
        """Lane whose centre is nearest to lateral position ``y`` (m), as a float tensor, on the road."""
        return self.clamp_lane(torch.round(y / self.lane_width_m))

    def centre_of(self, lane: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """Lateral position of the centre of ``lane``, m."""
        lane = lane if dtype is None else lane.to(dtype)
        return lane * self.lane_width_m

    def left_edge_m(self) -> float | Tensor:
        """Lateral position of the left edge of the road, m; the right edge is at minus half a lane width."""
        return (self.lanes - 0.5) * self.lane_width_m

    def right_edge_m(self) -> float | Tensor:
        """Lateral position of the right edge of the road, m."""
        return -0.5 * self.lane_width_m

    def distance_ahead(self, start: Tensor, end: Tensor) -> Tensor:
        """Signed distance ``end - start`` along the road, m; on a ring the shorter way."""
        distance = end - start
        if self.ring_m is None:
            return distance
        half = 0.5 * self.ring_m
        return torch.remainder(distance + half, self.ring_m) - half


def road_in(state: Any, default: Road) -> Road:
    """The road of each row from ``state["road"]`` (a TensorDict), or ``default`` without that key."""
    rows = state.get("road", None)
    return default if rows is None else Road(rows.get("lanes"), rows.get("lane_width_m"))
