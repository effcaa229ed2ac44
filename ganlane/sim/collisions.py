"""Overlap of oriented boxes by the separating-axis theorem, and soft crashes.

A soft crash is a dangerously small gap.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.sim.state import STRAIGHT, Road, Vehicles, reads_are_cheap

#: Pairs below which choosing the near ones takes longer than testing all of them. With 1024 rows
#: a decision of idm_random takes 4 % longer if all are tested.
FEW = 1000


def boxes_overlap(dx: Tensor, one: Vehicles, other: Vehicles) -> Tensor:
    """Whether the boxes of ``other``, ``dx`` m ahead of ``one``, overlap its box (touching does not
    count), elementwise.
    """
    dy = other.y - one.y
    c = torch.cos(one.heading)
    s = torch.sin(one.heading)
    oc = torch.cos(other.heading)
    os = torch.sin(other.heading)
    # Of the angle between the two boxes.
    cos = (c * oc + s * os).abs()
    sin = (c * os - s * oc).abs()
    # Separating axes: two rectangles are apart where the axis along or across one of them says so.
    boxes = [(0.5 * box.length, 0.5 * box.width) for box in (one, other)]

    def separated(
        along: Tensor, across: Tensor, box: tuple[Tensor, Tensor], against: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Whether an axis of a box separates it from the other; half lengths and widths."""
        reach_along = box[0] + against[0] * cos + against[1] * sin
        reach_across = box[1] + against[0] * sin + against[1] * cos
        return (along.abs() >= reach_along) | (across.abs() >= reach_across)

    by_own = separated(dx * c + dy * s, dy * c - dx * s, *boxes)
    by_other = separated(dx * oc + dy * os, dy * oc - dx * os, *reversed(boxes))
    return ~(by_own | by_other)


def ego_overlaps(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether the ego (index 0) overlaps each of the others, bool [N, M - 1]."""
    v = vehicles
    dx = road.distance_ahead(v.x[:, :1], v.x[:, 1:])
    both = v.valid[:, 1:] & v.valid[:, :1]
    if reads_are_cheap(dx):
        # Boxes overlap only within the sum of their half diagonals, each at most half of length
        # plus width.
        reach = v.length.amax() + v.width.amax()
        row, column = (dx.abs() < reach).nonzero().unbind(1)
        if len(row) == 0:
            return torch.zeros_like(both)
        if dx.numel() >= FEW:
            ego = v.part((row, 0))
            near = v.part((row, column + 1))
            # Only the near pairs are tested; all others are apart.
            hits = boxes_overlap(dx[row, column], ego, near)
            return torch.zeros_like(both).index_put((row, column), hits) & both
    ego = v.columns(slice(0, 1))
    others = v.columns(slice(1, None))
    return boxes_overlap(dx, ego, others) & both


def pair_overlaps(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether vehicles i and j overlap, bool [N, M, M], false on the diagonal."""
    # [N, M, 1] against [N, 1, M]: every vehicle with every other.
    one = vehicles.part((..., None))
    other = vehicles.part((slice(None), None))
    hit = boxes_overlap(road.distance_ahead(one.x, other.x), one, other)
    hit = hit & other.valid & one.valid
    itself = torch.eye(vehicles.x.shape[1], dtype=torch.bool, device=vehicles.x.device)
    return hit & ~itself


def dangerously_close(
    gap: Tensor, closing_speed: Tensor, ttc_s: float = 1.5, gap_m: float = 2.0
) -> Tensor:
    """Soft crash: gap under ``gap_m`` or time to collision under ``ttc_s``.

    Gap in m, closing speed in m/s.
    """
    # A product, since the time to collision divides by a closing speed that may be 0.
    return (gap < gap_m) | (gap < ttc_s * closing_speed)
