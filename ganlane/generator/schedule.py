"""How long a fit takes and how far each of its updates goes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class LoopConfig:
    """How long to fit.

    Attributes:
        updates: updates at most; the learning rate falls to 0 over them.
        evaluate_every: updates between two evaluations on the validation scenes.
        patience: evaluations without improvement before stopping.
        learning_rate: of Adam, after the warm-up.
        warmup: updates over which the learning rate rises.
        largest_gradient: norm at which gradients are cut.
        max_seconds: stop after this long; None is never.
    """

    updates: int = 1200
    evaluate_every: int = 150
    patience: int = 8
    learning_rate: float = 4e-3
    warmup: int = 100
    largest_gradient: float = 1.0
    max_seconds: float | None = None


def learning_rate(config: LoopConfig, number: int) -> float:
    """Linear warm-up, then a half cosine to 0."""
    rise = min(1.0, (number + 1) / max(1, config.warmup))
    return config.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * number / config.updates))


def descend(optimiser: torch.optim.Optimizer, loss: Tensor, module: nn.Module, largest: float) -> None:
    """One step of ``optimiser`` down ``loss``, with the gradient's norm cut at ``largest``."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(module.parameters(), largest)
    optimiser.step()
