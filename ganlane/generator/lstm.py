"""An LSTM over motions whose input projection can be kept, so that a window that moves on is not embedded anew."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ganlane.generator.dense import apply, dense

#: Typical displacement per 0.1 s and typical change of it, along and across the road, m: the networks' units.
DISPLACEMENT_SCALE_M = (1.0, 0.05)
DIFFERENCE_SCALE_M = (0.04, 0.02)
#: Changes of displacement are cut off here (in units of the scale): recorded positions jump now and then.
LARGEST_DIFFERENCE = 5.0
MOTION_FEATURES = 4


def motion_features(displacement: Tensor, difference: Tensor) -> Tensor:
    """Network inputs [..., 4] of displacements [..., 2] per 0.1 s and their differences to the step before, in m."""
    scaled = displacement / displacement.new_tensor(DISPLACEMENT_SCALE_M)
    change = difference / difference.new_tensor(DIFFERENCE_SCALE_M)
    return torch.cat([scaled, change.clamp(-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)], dim=-1)


class MotionLSTM(nn.Module):
    """Embedding with ReLU, then an LSTM cell in two parts: the projection of the input, and the recurrence.

    The gates stand in the order input, forget, output, new: the three that share an activation side by side.

    Args:
        embedding: width of the embedding.
        hidden: width H of the LSTM's state.
        differences: whether it is shown the displacements' differences; without, they read as 0 (an ablation).
    """

    def __init__(self, embedding: int, hidden: int, differences: bool = True):
        super().__init__()
        self.hidden, self.differences = hidden, differences
        self.embed = nn.Linear(MOTION_FEATURES, embedding)
        self.input = nn.Linear(embedding, 4 * hidden)
        self.recurrent = nn.Parameter(torch.empty(4 * hidden, hidden))
        bound = 1.0 / math.sqrt(hidden)
        nn.init.uniform_(self.recurrent, -bound, bound)
        with torch.no_grad():
            self.input.bias[hidden : 2 * hidden].fill_(1.0)  # remember, until it has learnt to forget

    def project(self, displacement: Tensor, difference: Tensor) -> Tensor:
        """The input's share [..., 4H] in the gates; depends on this motion alone, so it can be kept."""
        shown = difference if self.differences else torch.zeros_like(difference)
        return apply(self.input, apply(self.embed, motion_features(displacement, shown), relu=True))

    def step(self, projected: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        """One recurrence on a projection [..., 4H] and state ([..., H], [..., H]); returns the new state."""
        return self._update(dense(hidden, self.recurrent).add_(projected), cell)

    def encode(self, projections: Tensor | Sequence[Tensor]) -> Tensor:
        """Last hidden state [..., H] after the projections [..., T, 4H], or T of [..., 4H], from a state of zeros."""
        steps = projections.unbind(dim=-2) if isinstance(projections, Tensor) else projections
        hidden, cell = self._update(steps[0], torch.zeros_like(steps[0][..., : self.hidden]))
        for projected in steps[1:]:
            hidden, cell = self.step(projected, hidden, cell)
        return hidden

    @staticmethod
    def _update(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        width = cell.shape[-1]
        take, keep, show = torch.sigmoid(gates[..., : 3 * width]).chunk(3, dim=-1)
        cell = _times_tanh(take, gates[..., 3 * width :]) + keep * cell
        return _times_tanh(show, cell), cell


def _times_tanh(factor: Tensor, x: Tensor) -> Tensor:
    """``factor * tanh(x)`` by way of the sigmoid, which on a CPU takes a quarter of the time of ``torch.tanh``."""
    return torch.addcmul(-factor, factor, torch.sigmoid(x + x), value=2.0)
