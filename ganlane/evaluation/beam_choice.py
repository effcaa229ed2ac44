"""Which states a beam search keeps: no two alike, spread over lanes and over progress."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.keys import EGO_INDEX

#: States that agree in lane and change under way and within these steps are one: x and y in m, speed in m/s.
MERGED = {"x": 1.0, "y": 0.5, "speed": 0.5}


def choose(state: TensorDictBase, owner: Tensor, total: Tensor, beam: int, by_reward: bool) -> Tensor:
    """At most ``beam`` rows of ``state`` per episode, as their numbers in growing order.

    Args:
        state: batch [rows].
        owner: which episode each row belongs to, [rows] int64.
        total: what each row has earned, [rows].
        beam: rows kept per episode.
        by_reward: within a lane keep those that earned most, rather than the foremost and the hindmost.
    """
    vehicles = state.get(keys.VEHICLES)
    ego = {name: vehicles.get(name)[:, EGO_INDEX] for name in MERGED}
    cell = (owner, vehicles.get("target_lane")[:, EGO_INDEX], state.get(keys.EGO).get("change_direction"))
    near = [torch.floor(value / MERGED[name]) for name, value in ego.items()]
    gain = total if by_reward else ego["x"]
    distinct = order(*cell, *near, -gain)
    distinct = distinct[rank(*(column[distinct] for column in (*cell, *near))) == 0]
    # Within a lane: the best first, or the foremost and the hindmost in turn.
    ranked = distinct[order(*(column[distinct] for column in cell), -gain[distinct])]
    place = rank(*(column[ranked] for column in cell))
    if not by_reward:
        backwards = rank(*(column[ranked].flip(0) for column in cell)).flip(0)
        place = torch.minimum(place, backwards)
    chosen = ranked[order(owner[ranked], place)]
    return chosen[rank(owner[chosen]) < beam].sort().values


def order(*columns: Tensor) -> Tensor:
    """Rows sorted by the first column, ties by the second, and so on; the rest as they stand."""
    rows = torch.arange(columns[0].shape[0], device=columns[0].device)
    for column in reversed(columns):
        rows = rows[torch.argsort(column[rows], stable=True)]
    return rows


def rank(*columns: Tensor) -> Tensor:
    """Of sorted rows: how many of the same values stand before each, [rows] int64."""
    index = torch.arange(columns[0].shape[0], device=columns[0].device)
    new = torch.zeros_like(index, dtype=torch.bool)
    new[:1] = True
    for column in columns:
        new[1:] |= column[1:] != column[:-1]
    return index - torch.where(new, index, 0).cummax(0).values if len(index) else index
