"""What the updates of all fits have in common."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def descend(
    optimizer: torch.optim.Optimizer, loss: Tensor, largest_gradient: float = math.inf
) -> float:
    """One step down the ``loss``, whose value is returned.

    Args:
        optimizer: of the parameters that the loss depends on.
        loss: a number.
        largest_gradient: norm to which the gradient of the optimizer's first group is clipped.
    """
    optimizer.zero_grad()
    loss.backward()
    if largest_gradient < math.inf:
        nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], largest_gradient)
    optimizer.step()
    return float(loss.detach())


def half_cosine(update: int, updates: int) -> float:
    """Share of the learning rate, from 1 at the first update down to 0 after the last one.

    Args:
        update: its number, from 0 on.
        updates: how many there are.
    """
    return 0.5 * (1.0 + math.cos(math.pi * update / updates))
