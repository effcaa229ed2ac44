"""The generator's and the discriminator's losses (Gupta et al. 2018, with the changes that the fit needs here)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

#: Keeps the gradient of a distance of 0 finite; 0.1 mm.
_SMALLEST_DISTANCE_M = 1e-4


def distance(one: Tensor, other: Tensor) -> Tensor:
    """Euclidean distance [...] between positions [..., 2], with a finite gradient at distance 0."""
    apart = one - other
    return torch.sqrt((apart * apart).sum(-1) + _SMALLEST_DISTANCE_M * _SMALLEST_DISTANCE_M)


def distances(predicted: Tensor, recorded: Tensor) -> Tensor:
    """Distances [..., T] in m between two trajectories given as displacements [..., T, 2]."""
    apart = (predicted - recorded).cumsum(dim=-2)
    return distance(apart, torch.zeros_like(apart))


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (broadcast) is true; 0 if it is nowhere."""
    kept = mask.expand_as(values).to(values.dtype)
    return (values * kept).sum() / kept.sum().clamp_min(1.0)


def variety_loss(errors: Tensor) -> Tensor:
    """Mean error of each vehicle's best sample; ``errors`` is [K, n] in m."""
    return errors.amin(dim=0).mean()


def adversarial_loss(logits: Tensor) -> Tensor:
    """Cross-entropy of classifying generated trajectories as recorded; ln 2 is chance."""
    return binary_cross_entropy_with_logits(logits, torch.ones_like(logits), reduction="none").mean()


def discriminator_loss(recorded: Tensor, generated: Tensor) -> Tensor:
    """Cross-entropy of classifying recorded and generated trajectories by their logits; ln 2 is chance."""
    fake = binary_cross_entropy_with_logits(generated, torch.zeros_like(generated), reduction="none").mean()
    return 0.5 * (adversarial_loss(recorded) + fake)


def discriminator_accuracy(recorded: Tensor, generated: Tensor) -> Tensor:
    """Share of logits with the right sign, both classes with equal weight; 0.5 is chance."""
    return 0.5 * ((recorded > 0).to(recorded.dtype).mean() + (generated <= 0).to(generated.dtype).mean())


def energy_score(one: Tensor, other: Tensor, recorded: Tensor) -> Tensor:
    """Energy score of two samples, in the unit of the positions: mean error minus half their distance.

    All are positions [..., 2]. A proper score: least in expectation when the samples are drawn from the distribution
    of the recordings (Gneiting and Raftery 2007).
    """
    mean_error = 0.5 * (distance(one, recorded) + distance(other, recorded))
    return mean_error - 0.5 * distance(one, other)
