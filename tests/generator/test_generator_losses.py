import math

import pytest
import torch

from ganlane.generator.losses import (
    adversarial_loss,
    discriminator_accuracy,
    discriminator_loss,
    distance,
    distances,
    energy_score,
    masked_mean,
    variety_loss,
)
from ganlane.generator.segments import constant_velocity


def test_distance_is_euclidean_and_accumulates():
    predicted = torch.tensor([[[3.0, 4.0], [0.0, 0.0], [3.0, 4.0]]])
    torch.testing.assert_close(distances(predicted, torch.zeros(1, 3, 2)), torch.tensor([[5.0, 5.0, 10.0]]))


def test_the_gradient_of_a_perfect_prediction_is_finite():
    predicted = torch.zeros(1, 8, 2, requires_grad=True)
    distances(predicted, torch.zeros(1, 8, 2)).sum().backward()
    assert predicted.grad.isfinite().all()


def test_only_each_vehicles_best_sample_counts_for_variety():
    errors = torch.tensor([[1.0, 9.0], [5.0, 3.0]])
    assert variety_loss(errors).item() == pytest.approx(2.0)


def test_masked_vehicles_do_not_count():
    values = torch.tensor([[1.0, 100.0]])
    assert masked_mean(values, torch.tensor([[True, False]])).item() == 1.0
    assert masked_mean(values, torch.zeros(1, 2, dtype=torch.bool)).item() == 0.0


def test_an_undecided_discriminator_loses_ln_2():
    zeros = torch.zeros(1, 2)
    assert discriminator_loss(zeros, zeros).item() == pytest.approx(math.log(2))
    assert adversarial_loss(zeros).item() == pytest.approx(math.log(2))


def test_accuracy_counts_both_kinds_alike():
    assert discriminator_accuracy(torch.ones(1, 2), -torch.ones(1, 2)).item() == 1.0
    assert discriminator_accuracy(torch.ones(1, 2), torch.ones(1, 2)).item() == 0.5


def test_the_energy_score_is_least_for_the_right_spread():
    torch.manual_seed(0)
    recorded = torch.randn(20000, 2)
    scores = {
        spread: energy_score(spread * torch.randn(20000, 2), spread * torch.randn(20000, 2), recorded).mean().item()
        for spread in (0.01, 0.5, 1.0, 1.5, 2.5)
    }
    assert min(scores, key=scores.get) == 1.0


def test_constant_velocity_of_a_steady_brake_errs_by_its_sum():
    steps = torch.arange(16.0)
    displacements = torch.stack([1.5 - 0.01 * steps, torch.zeros(16)], dim=-1)[None, None]
    past, future = displacements[..., :8, :], displacements[..., 8:, :]
    errors = distance(constant_velocity(past[..., -1, :], 8), future.cumsum(-2))
    expected = torch.tensor([0.01 * n * (n + 1) / 2 for n in range(1, 9)])
    torch.testing.assert_close(errors[0, 0], expected, atol=1e-5, rtol=1e-4)
