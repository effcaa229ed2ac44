"""Distributions on a fixed support (Bellemare et al. 2017)."""

from __future__ import annotations

import torch
from torch import Tensor


def project(values: Tensor, probabilities: Tensor, support: Tensor) -> Tensor:
    """Project the distribution with ``probabilities`` [B, K] at ``values`` [B, K] onto ``support`` [K].

    Values outside the support are clamped to its ends. Each mass is split between its two neighbours in proportion
    to the nearness of the other (Bellemare et al. 2017, equation 7); the mean is kept but for the clamping.
    """
    low, high, atoms = support[0], support[-1], support.numel()
    place = (values.clamp(low, high) - low) * ((atoms - 1) / (high - low))
    lower = place.floor().clamp_max(atoms - 2)
    share = (place - lower) * probabilities
    index = lower.long()
    projected = torch.zeros_like(probabilities)
    projected.scatter_add_(1, index, probabilities - share)
    return projected.scatter_add_(1, index + 1, share)


def outside_support(values: Tensor, probabilities: Tensor, support: Tensor) -> Tensor:
    """Probability mass that :func:`project` clamps, averaged over the batch, 0-dim."""
    outside = (values < support[0]) | (values > support[-1])
    return (probabilities * outside).sum(-1).mean()


def pick(rows: Tensor, action: Tensor) -> Tensor:
    """Rows [B, K] of ``rows`` [B, A, K] at the actions [B]."""
    return rows.gather(1, action.view(-1, 1, 1).expand(-1, 1, rows.shape[-1])).squeeze(1)
