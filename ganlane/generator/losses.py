"""The generator's and the discriminator's losses (Gupta et al. 2018, with the changes that made it learn here)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

#: Keeps the gradient of a distance of 0 finite; 0.1 mm.
_SMALLEST_DISTANCE_M = 1e-4


@dataclass(frozen=True)
class LossWeights:
    """Weights of the generator's terms; a weight of 0 switches a term off.

    Attributes:
        variety: the best of the samples (variety alone makes a single sample worse than constant velocity).
        single: the mean over the samples.
        mean: the prediction for z = 0.
        adversarial: cross-entropy of the discriminator's logits.
    """

    variety: float = 1.6
    single: float = 1.0
    mean: float = 1.0
    adversarial: float = 0.02


def distances(predicted: Tensor, recorded: Tensor) -> Tensor:
    """Euclidean distances [..., T] in m between two courses given as displacements [..., T, 2]."""
    apart = (predicted - recorded).cumsum(dim=-2)
    return torch.sqrt((apart * apart).sum(-1) + _SMALLEST_DISTANCE_M * _SMALLEST_DISTANCE_M)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (broadcast) holds."""
    kept = mask.expand_as(values).to(values.dtype)
    return (values * kept).sum() / kept.sum().clamp_min(1.0)


def variety_loss(errors: Tensor, mask: Tensor) -> Tensor:
    """Mean error of each vehicle's best sample; ``errors`` is [K, B, G] in m, ``mask`` [B, G]."""
    return masked_mean(errors.amin(dim=0), mask)


def adversarial_loss(logits: Tensor, mask: Tensor) -> Tensor:
    """Cross-entropy of calling the generated courses recorded; ``logits`` and ``mask`` are [..., B, G]."""
    return masked_mean(binary_cross_entropy_with_logits(logits, torch.ones_like(logits), reduction="none"), mask)


def discriminator_loss(recorded: Tensor, generated: Tensor, mask: Tensor) -> Tensor:
    """Cross-entropy of telling the two apart; logits [..., B, G] each; ln 2 is chance."""
    true = binary_cross_entropy_with_logits(recorded, torch.ones_like(recorded), reduction="none")
    false = binary_cross_entropy_with_logits(generated, torch.zeros_like(generated), reduction="none")
    return 0.5 * (masked_mean(true, mask) + masked_mean(false, mask))


def discriminator_accuracy(recorded: Tensor, generated: Tensor, mask: Tensor) -> Tensor:
    """Share told right, recorded and generated counted alike; 0.5 is chance."""
    right_true, right_false = (recorded > 0).to(recorded.dtype), (generated <= 0).to(generated.dtype)
    return 0.5 * (masked_mean(right_true, mask) + masked_mean(right_false, mask))


def energy_score(one: Tensor, other: Tensor, recorded: Tensor) -> Tensor:
    """Energy score of two samples, in the unit of the positions: mean error less half their distance.

    All are positions [..., 2]; a proper score, least in expectation when the samples are drawn from the
    distribution of what was recorded (Gneiting and Raftery 2007).
    """
    mean_error = 0.5 * (distance(one, recorded) + distance(other, recorded))
    return mean_error - 0.5 * distance(one, other)


def distance(one: Tensor, other: Tensor) -> Tensor:
    """Euclidean distance [...] between positions [..., 2], with a finite gradient where they meet."""
    apart = one - other
    return torch.sqrt((apart * apart).sum(-1) + _SMALLEST_DISTANCE_M * _SMALLEST_DISTANCE_M)
