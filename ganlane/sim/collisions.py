"""Overlap of oriented boxes by the separating-axis theorem, and soft crashes (dangerously small gaps)."""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.sim.state import STRAIGHT, Road, Vehicles, reads_are_cheap

#: Pairs below which choosing the near ones takes longer than testing all of them.
FEW = 1000


def _separated(
    along: Tensor,
    across: Tensor,
    half_length: Tensor,
    half_width: Tensor,
    other_length: Tensor,
    other_width: Tensor,
    cos: Tensor,
    sin: Tensor,
) -> Tensor:
    """Whether an axis of the first box separates it from the other, whose axes are turned by (cos, sin)."""
    reach_along = half_length + other_length * cos + other_width * sin
    reach_across = half_width + other_length * sin + other_width * cos
    return (along.abs() >= reach_along) | (across.abs() >= reach_across)


def boxes_overlap(
    dx: Tensor,
    dy: Tensor,
    heading: Tensor,
    length: Tensor,
    width: Tensor,
    other_heading: Tensor,
    other_length: Tensor,
    other_width: Tensor,
) -> Tensor:
    """Whether two oriented boxes overlap (touching does not count), elementwise.

    Args:
        dx, dy: from the centre of the first box to the centre of the other, m.
        heading, length, width: of the first box, rad and m; ``other_*``: of the other.
    """
    c, s = torch.cos(heading), torch.sin(heading)
    oc, os = torch.cos(other_heading), torch.sin(other_heading)
    # Of the angle between the two boxes.
    cos, sin = (c * oc + s * os).abs(), (c * os - s * oc).abs()
    own = (0.5 * length, 0.5 * width)
    other = (0.5 * other_length, 0.5 * other_width)
    by_own = _separated(dx * c + dy * s, dy * c - dx * s, *own, *other, cos, sin)
    by_other = _separated(dx * oc + dy * os, dy * oc - dx * os, *other, *own, cos, sin)
    return ~(by_own | by_other)


def ego_overlaps(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether the ego (index 0) overlaps each of the others, bool [N, M - 1]."""
    v = vehicles
    dx = road.distance_ahead(v.x[:, :1], v.x[:, 1:])
    both = v.valid[:, 1:] & v.valid[:, :1]
    if reads_are_cheap(dx):
        # Boxes overlap only within the sum of their half diagonals, each at most half of length plus width.
        row, column = (dx.abs() < v.length.amax() + v.width.amax()).nonzero().unbind(1)
        if len(row) == 0:
            return torch.zeros_like(both)
        if dx.numel() >= FEW:
            ego, near = (Vehicles(*(field[row, which] for field in v)) for which in (0, column + 1))
            return torch.zeros_like(both).index_put((row, column), _ego_hits(dx[row, column], ego, near)) & both
    return _ego_hits(dx, v.columns(slice(0, 1)), v.columns(slice(1, None))) & both


def _ego_hits(dx: Tensor, ego: Vehicles, others: Vehicles) -> Tensor:
    """Whether the boxes of others, ``dx`` m ahead of the ego, overlap its own."""
    return boxes_overlap(
        dx, others.y - ego.y, ego.heading, ego.length, ego.width, others.heading, others.length, others.width
    )


def pair_overlaps(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether vehicles i and j overlap, bool [N, M, M], false on the diagonal."""
    v = vehicles
    hit = boxes_overlap(
        road.distance_ahead(v.x[:, :, None], v.x[:, None]),
        v.y[:, None] - v.y[:, :, None],
        v.heading[:, :, None],
        v.length[:, :, None],
        v.width[:, :, None],
        v.heading[:, None],
        v.length[:, None],
        v.width[:, None],
    )
    both = v.valid[:, None] & v.valid[:, :, None]
    return hit & both & ~torch.eye(v.x.shape[1], dtype=torch.bool, device=v.x.device)


def dangerously_close(gap: Tensor, closing_speed: Tensor, ttc_s: float = 1.5, gap_m: float = 2.0) -> Tensor:
    """Soft crash: gap under ``gap_m`` or time to collision under ``ttc_s``; gap in m, closing speed in m/s."""
    return (gap < gap_m) | (gap < ttc_s * closing_speed)
