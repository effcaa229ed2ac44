"""The state of the simulation: the vehicles as tensors, and the road they drive on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ganlane.keys import VEHICLE_FIELDS


def compact(chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Where the few true entries of ``chosen`` [N, M] are: rows [R], and columns [R, W] that hold all of theirs.

    Reads values, so it belongs on a CPU and in no graph (:func:`reads_are_cheap`).
    """
    rows = chosen.any(1).nonzero()[:, 0]
    chosen = chosen[rows]
    most = int(chosen.sum(1).max()) if len(rows) else 0
    return rows, chosen.to(torch.uint8).sort(dim=1, descending=True, stable=True).indices[:, :most]


def reads_are_cheap(tensor: Tensor) -> bool:
    """Whether a value can be read without breaking a graph that is being compiled, or stalling a GPU's queue."""
    return tensor.device.type == "cpu" and not torch.compiler.is_compiling()


class Vehicles(NamedTuple):
    """Fields of ``vehicles`` (:mod:`ganlane.keys`), each of shape [N, M] (or [N] for one vehicle per row)."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    length: Tensor
    width: Tensor
    desired_speed: Tensor
    target_lane: Tensor
    visibility: Tensor
    valid: Tensor

    @classmethod
    def of(cls, mapping: Any) -> Vehicles:
        """From a mapping of names to tensors, for example a TensorDict."""
        named = dict(mapping.items())
        return cls(*(named[name] for name in VEHICLE_FIELDS))

    def as_dict(self) -> dict[str, Tensor]:
        """Name to tensor, without copies."""
        return self._asdict()

    def with_(self, **changed: Tensor) -> Vehicles:
        """The same vehicles with some fields replaced."""
        return self._replace(**changed)

    def at(self, index: int) -> Vehicles:
        """Vehicle ``index`` of every row, fields [N]."""
        return Vehicles(*(field[:, index] for field in self))

    def columns(self, which: slice | Tensor) -> Vehicles:
        """A slice of the vehicles of every row, or those with the indices [N, K]; fields [N, K]."""
        if isinstance(which, Tensor):
            return Vehicles(*(field.gather(1, which) for field in self))
        return self if which == slice(None) else Vehicles(*(field[:, which] for field in self))

    def with_first(self, first: Vehicles) -> Vehicles:
        """The same rows with vehicle 0 replaced by ``first`` (fields [N])."""
        is_first = torch.arange(self.x.shape[1], device=self.x.device) == 0
        return Vehicles(*(torch.where(is_first, one[:, None], all_) for one, all_ in zip(first, self)))

    def with_finite_padding(self) -> Vehicles:
        """The same vehicles with finite numbers in invalid entries, so that NaN does not spread through sums."""

        def finite(field: Tensor) -> Tensor:
            return torch.where(self.valid, field, torch.nan_to_num(field, 1.0, 1.0, 1.0))

        return Vehicles(*(finite(field) if field.is_floating_point() else field for field in self))

    def where(self, rows: Tensor, other: Vehicles) -> Vehicles:
        """These vehicles where ``rows`` ([N], [N, 1] or [N, M]) is true, ``other`` elsewhere."""
        mask = rows[:, None] if rows.ndim == 1 else rows
        return Vehicles(*(torch.where(mask, mine, theirs) for mine, theirs in zip(self, other)))


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


#: Three straight lanes of 4 m.
STRAIGHT = Road()


def road_in(state: Any, default: Road) -> Road:
    """The road of each row from ``state["road"]`` (a TensorDict), or ``default`` without that key."""
    rows = state.get("road", None)
    return default if rows is None else Road(rows.get("lanes"), rows.get("lane_width_m"))
