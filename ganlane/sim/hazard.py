"""Equation 10: when a driver of generated traffic starts a lane change."""

from __future__ import annotations

import torch
from torch import Tensor


def literal_hazard(clock: Tensor, mean_steps: float) -> Tensor:
    """Probability ``t / t_m`` per step of starting a change, for ``clock`` steps since the last one ended.

    Equation 10 read literally: the probability grows until a change is certain at ``t = t_m``, so the mean waiting
    time is about ``sqrt(pi t_m / 2)`` steps, not ``t_m``.
    """
    return (clock / mean_steps).clamp(0.0, 1.0)


def distance_hazard(speed: Tensor, changes_per_km: float, dt: float) -> Tensor:
    """Probability per step of ``dt`` s of starting a change, at a constant rate per kilometre driven."""
    return 1.0 - torch.exp(-speed * (dt * changes_per_km / 1000.0))


def random_side(u: Tensor, lane: Tensor, lanes: int | Tensor) -> Tensor:
    """A random side on which a lane exists: -1 right, +1 left, 0 on a single-lane road; ``u`` uniform, ``lane``
    int64."""
    left, right = lane < lanes - 1, lane > 0
    both = torch.where(u < 0.5, 1, -1)
    return torch.where(left & right, both, torch.where(left, 1, torch.where(right, -1, 0)))
