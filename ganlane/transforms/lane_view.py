"""The lane view: Table III's numbers, reordered and summarised by lane, and the lengths of the vehicles.

For the left, the own and the right lane the nearest vehicle ahead and behind: gap, ``exp(-gap / 15 m)`` and
relative speed. A small network reads advantages of a lane change from it that it does not find in the list of
vehicles, nearest first (the order of that list changes whenever two vehicles swap ranks).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.transforms.table3 import ObservationScale, Others

#: Scale of the nearness feature, m.
NEARNESS_M = 15.0
#: Overlap along the road that adds 1 to the nearness, m: drivers beside brake so hard that one metre decides.
OVERLAP_M = 1.0
LANE_VIEW_SIZE = 18
DRIFT_SIZE = 6


#: Lane to the left, own, to the right, each ahead (+1) and behind (-1).
_SIDES = (1.0, 1.0, 0.0, 0.0, -1.0, -1.0)
_WAYS = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
#: Stands for a distance, or a speed, of nobody.
_NOBODY = 1e9


def largest_nearness(longest_m: float) -> float:
    """The nearness of somebody exactly beside the ego, where overlap counts and no body is above ``longest_m``."""
    return 1.0 + longest_m / OVERLAP_M


def lane_offset(others: Others, lanes: int | Tensor) -> Tensor:
    """Lanes between the ego and each of the others, [N, M - 1]."""
    widest = (lanes - 1).clamp_min(1) if isinstance(lanes, Tensor) else max(lanes - 1, 1)
    return torch.round(others.lane * widest)


def lane_view(
    others: Others, lanes: int | Tensor, scale: ObservationScale, drift: bool = False, overlap: bool = False
) -> Tensor:
    """[N, 18]: left, own and right lane x ahead and behind x (gap, nearness, relative speed); (1, 0, 0) for nobody.

    The gap, over the range of sight, is from bumper to bumper by the lengths of the two (:attr:`Others.bumpers_m`);
    the nearest is who has the nearest centre, and somebody beside the ego counts as behind. With ``drift`` [N, 24]: a
    fourth number tells where in its lane that vehicle is (:attr:`Others.drift`), by which a lane change shows before
    its middle; this is information that Table III does not have. With ``overlap`` the gap goes below 0 where the two
    bodies overlap along the road, and the nearness above 1, by 1 per metre; without, all of them look alike, from
    bumper to bumper to side by side.
    """
    side, way = (others.position.new_tensor(each)[:, None] for each in (_SIDES, _WAYS))
    distance = others.position[:, None, :] * way
    in_sight = (others.valid & (others.position.abs() < 1.0))[:, None, :]
    there = (distance > 0) | ((distance == 0) & (way < 0))
    counts = in_sight & there & (lane_offset(others, lanes)[:, None, :] == side)
    distance = torch.add(distance, ~counts, alpha=_NOBODY)
    nearest = distance.amin(-1, keepdim=True)
    farther, found = distance > nearest, nearest <= 1.0

    def of_the_nearest(field: Tensor) -> Tensor:
        value = torch.add(field[:, None, :], farther, alpha=_NOBODY).amin(-1, keepdim=True)
        return torch.where(found, value, 0.0)

    gap_m = nearest * scale.range_m + of_the_nearest(-others.bumpers_m)  # of two as near the longer one counts
    gap_m = gap_m if overlap else gap_m.clamp_min(0.0)
    gap = torch.where(found, gap_m / scale.range_m, 1.0)
    overlap_m = (-gap_m).clamp_min(0.0)
    nearness = torch.where(found, torch.exp(-gap_m.clamp_min(0.0) / NEARNESS_M) + overlap_m / OVERLAP_M, 0.0)
    seen = (gap, nearness, of_the_nearest(others.speed), *((of_the_nearest(others.drift),) if drift else ()))
    return torch.cat(seen, dim=-1).flatten(1)
