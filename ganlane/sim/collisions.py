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
    """Whether two boxes overlap, elementwise, bool; touching does not count.

    By the separating-axis theorem: two rectangles are apart where their projections on the axis
    along or across one of them are apart.

    Args:
        dx: how far the centre of ``other`` is ahead of that of ``one``, m.
        one, other: their fields broadcast with ``dx``.
    """
    dy = other.y - one.y
    cos_one = torch.cos(one.heading)
    sin_one = torch.sin(one.heading)
    cos_other = torch.cos(other.heading)
    sin_other = torch.sin(other.heading)

    # Of the angle between the two boxes. A box is symmetric, so signs do not matter.
    cos = (cos_one * cos_other + sin_one * sin_other).abs()
    sin = (cos_one * sin_other - sin_one * cos_other).abs()
    half_sizes = [(0.5 * box.length, 0.5 * box.width) for box in (one, other)]

    def separated(
        along: Tensor,
        across: Tensor,
        box: tuple[Tensor, Tensor],
        against: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Whether an axis of a box separates it from the other.

        Args:
            along, across: from one centre to the other, on the axes of ``box``, m.
            box, against: half lengths and widths, m.
        """
        half_length, half_width = box
        other_length, other_width = against
        # Distances of the centres at which the projections touch.
        reach_along = half_length + other_length * cos + other_width * sin
        reach_across = half_width + other_length * sin + other_width * cos
        return (along.abs() >= reach_along) | (across.abs() >= reach_across)

    # The vector between the centres, turned into the axes of the one and of the other box.
    along_one = dx * cos_one + dy * sin_one
    across_one = dy * cos_one - dx * sin_one
    by_one = separated(along_one, across_one, *half_sizes)

    along_other = dx * cos_other + dy * sin_other
    across_other = dy * cos_other - dx * sin_other
    by_other = separated(along_other, across_other, *reversed(half_sizes))

    return ~(by_one | by_other)


def ego_overlaps(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether the ego (index 0) overlaps each of the others, bool [N, M - 1].

    Never with an invalid vehicle.
    """
    dx = road.distance_ahead(vehicles.x[:, :1], vehicles.x[:, 1:])
    both_valid = vehicles.valid[:, 1:] & vehicles.valid[:, :1]

    # Most pairs are far apart: where a look at the numbers is cheap, only the others are tested.
    if reads_are_cheap(dx):
        # Places [P] of the P near pairs in [N, M - 1].
        # Boxes overlap only within the sum of their half diagonals, each at most half of length
        # plus width.
        reach = vehicles.length.amax() + vehicles.width.amax()
        row, column = (dx.abs() < reach).nonzero().unbind(1)
        if len(row) == 0:
            return torch.zeros_like(both_valid)

        if dx.numel() >= FEW:
            ego = vehicles.part((row, 0))
            near = vehicles.part((row, column + 1))
            hits = boxes_overlap(dx[row, column], ego, near)
            hit = torch.zeros_like(both_valid).index_put((row, column), hits)
            return hit & both_valid

    # [N, 1] against [N, M - 1].
    ego = vehicles.columns(slice(0, 1))
    others = vehicles.columns(slice(1, None))
    return boxes_overlap(dx, ego, others) & both_valid


def pair_overlaps(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether vehicles i and j overlap, bool [N, M, M], false on the diagonal.

    Never with an invalid vehicle.
    """
    # [N, M, 1] against [N, 1, M]: every vehicle with every other.
    one = vehicles.part((..., None))
    other = vehicles.part((slice(None), None))
    dx = road.distance_ahead(one.x, other.x)
    hit = boxes_overlap(dx, one, other) & other.valid & one.valid

    itself = torch.eye(vehicles.x.shape[1], dtype=torch.bool, device=vehicles.x.device)
    return hit & ~itself


def dangerously_close(
    gap: Tensor,
    closing_speed: Tensor,
    ttc_s: float = 1.5,
    gap_m: float = 2.0,
) -> Tensor:
    """Whether this is a soft crash, elementwise, bool.

    Args:
        gap: between the bumpers, m.
        closing_speed: of the one behind less that of the one ahead, m/s.
        ttc_s: a shorter time to collision is one, s.
        gap_m: and so is a smaller gap, m.
    """
    # A product, since the time to collision divides by a closing speed that may be 0.
    return (gap < gap_m) | (gap < ttc_s * closing_speed)
