"""The lane view: Table III's numbers, reordered and summarised by lane. No new information.

For the left, the own and the right lane the nearest vehicle ahead and behind: gap, ``exp(-gap / 15 m)`` and
relative speed. A small network reads advantages of a lane change from it that it does not find in the list of
vehicles, nearest first (the order of that list changes whenever two vehicles swap ranks).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.transforms.table3 import ObservationScale, Others

#: Scale of the nearness feature, m, and the length taken off the distance between centres, m.
NEARNESS_M = 15.0
CAR_LENGTH_M = 4.5
LANE_VIEW_SIZE = 18


def _nearest(others: Others, mask: Tensor, sign: float, scale: ObservationScale) -> Tensor:
    """(gap over range, nearness, relative speed) of the nearest of ``mask``, [N, 3]; (1, 0, 0) without one."""
    distance = torch.where(mask, sign * others.position, 2.0)
    nearest = distance.amin(1, keepdim=True)
    speeds = torch.where(mask & (distance == nearest), others.speed, torch.inf).amin(1, keepdim=True)
    there = nearest <= 1.0
    gap_m = (nearest * scale.range_m - CAR_LENGTH_M).clamp_min(0.0)
    gap = torch.where(there, gap_m / scale.range_m, 1.0)
    nearness = torch.where(there, torch.exp(-gap_m / NEARNESS_M), 0.0)
    return torch.cat((gap, nearness, torch.where(there, speeds, 0.0)), dim=1)


def lane_view(others: Others, lanes: int | Tensor, scale: ObservationScale) -> Tensor:
    """[N, 18]: left, own and right lane x ahead and behind x (gap, nearness, relative speed)."""
    if isinstance(lanes, Tensor):
        widest = (lanes - 1).clamp_min(1)
        offset = torch.round(others.lane * widest)
    else:
        offset = torch.round(others.lane * max(lanes - 1, 1))
    in_sight = others.valid & (others.position.abs() < 1.0)
    views = []
    for side in (1, 0, -1):
        in_lane = in_sight & (offset == side)
        views.append(_nearest(others, in_lane & (others.position > 0), 1.0, scale))
        views.append(_nearest(others, in_lane & (others.position <= 0), -1.0, scale))
    return torch.cat(views, dim=1)
