"""Table III's numbers with a place for every role: nearest ahead and behind in each lane, then the next ones.

The list, nearest first, changes its order whenever two vehicles swap ranks; here a place always means the same. In
groups of three (lane to the left, own, to the right): the nearest ahead, the nearest behind, the second ahead, the
second behind and so on, as many groups as hold M - 1 vehicles. Who is two or more lanes away, or of a rank without a
place, is left out.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.transforms.lane_view import lane_offset
from ganlane.transforms.table3 import Others, nearest_first

#: Lanes that have places: to the left, own, to the right.
LANES = 3


def places(others: int) -> int:
    """How many places there are for so many other vehicles: whole groups of three."""
    return LANES * -(-others // LANES)


def fixed_order(others: Others, distance: Tensor, lanes: int | Tensor) -> Others:
    """``others`` [N, M - 1] in their places, [N, :func:`places`]; an empty place reads (1, 0, 0), far ahead.

    Args:
        others: in any order.
        distance: of each to the ego, m, [N, M - 1]; the ranks follow from it.
        lanes: of the road.
    """
    others = nearest_first(others, distance)
    count = places(others.position.shape[1])
    place = place_of(others, lanes)
    # Those without a place share one behind the last, which is cut off.
    place = torch.where(place < count, place, count)
    fields = (
        torch.full((len(place), count + 1), empty, dtype=field.dtype, device=field.device).scatter(1, place, field)
        for field, empty in zip(others, (1.0, 0.0, 0.0, False, 0.0, 0.0))
    )
    return Others(*(field[:, :count] for field in fields))


def place_of(others: Others, lanes: int | Tensor) -> Tensor:
    """Place of each of the ``others``, nearest first, [N, M - 1] int64; very large for whom there is none.

    Somebody beside the ego counts as behind, as in the lane view.
    """
    column = 1 - lane_offset(others, lanes).long()
    behind = (others.position <= 0).long()
    has_place = others.valid & (column >= 0) & (column < LANES)
    role = torch.where(has_place, behind * LANES + column, -1)
    same = role[:, :, None] == torch.arange(2 * LANES, device=role.device)
    rank = (same.cumsum(1) * same).sum(-1) - 1
    return torch.where(has_place, rank * 2 * LANES + role, torch.iinfo(torch.int64).max)
