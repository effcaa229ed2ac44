"""Random numbers as pure functions of (stream, seed, episode, vehicle, step, purpose)."""

import itertools
import math

import pytest
import torch
from reference import scalar
from reference.worlds import episode_keys

from ganlane.sim.random import (
    Purpose,
    Stream,
    draw_keys,
    episode_key,
    normal,
    to_uniform,
    uniform,
)

PURPOSES = [int(p) for p in Purpose]
KEYS = episode_keys(range(20_000))


def test_fields_are_mixed_in_one_after_the_other_by_the_finaliser_of_splitmix64():
    drawn = draw_keys(episode_key(2, torch.tensor([5]), torch.tensor([2**40])), 17, 3, [4, 9])
    for vehicle, (column, purpose) in itertools.product(range(3), enumerate([4, 9])):
        expected = scalar.drawn(2, 0, 5, 2**40, 17, vehicle, purpose)
        assert drawn[0, vehicle, column].item() % 2**64 == expected


def chi_square(u):
    """Of 64 equal bins, as a standard score."""
    bins = 64
    counts = torch.bincount((u.flatten() * bins).long(), minlength=bins).double()
    expected = u.numel() / bins
    statistic = ((counts - expected) ** 2 / expected).sum().item()
    return (statistic - (bins - 1)) / math.sqrt(2 * (bins - 1))


def test_numbers_are_uniform_along_every_field():
    """Each slice of the numbers fills 64 bins evenly (4.5 standard deviations, some 90 slices)."""
    by_episode = uniform(KEYS[:4000], 3, 4, PURPOSES)
    by_step = uniform(torch.full((4000,), 42), torch.arange(4000), 4, PURPOSES)
    by_vehicle = uniform(KEYS[:2], 0, 8000, [Purpose.NOISE])
    by_seed = uniform(episode_key(1, torch.arange(16000), torch.zeros(16000).long()), 0, 1, [0])
    slices = [*by_episode.unbind(2), *by_step.unbind(2), *by_episode.unbind(1), by_vehicle, by_seed]
    assert max(abs(chi_square(u)) for u in slices) < 4.5
    assert by_episode.min() >= 0.0
    assert by_episode.max() < 1.0


def test_no_two_places_share_a_number():
    """All of a block of (stream, seed, episode, step, vehicle, purpose), the fields' values
    overlapping.
    """
    seen = []
    for stream, step in itertools.product(Stream, range(6)):
        seed, episode = torch.meshgrid(torch.arange(6), torch.arange(6), indexing="ij")
        key = episode_key(stream, seed.flatten(), episode.flatten())
        seen.append(draw_keys(key, step, 6, list(range(6))).flatten())
    seen = torch.cat(seen)
    assert seen.unique().numel() == seen.numel() == len(Stream) * 6**5


def test_float32_and_float64_numbers_agree_to_24_bits():
    single = uniform(KEYS[:1000], 5, 3, [1, 2], torch.float32)
    double = uniform(KEYS[:1000], 5, 3, [1, 2], torch.float64)
    assert torch.equal((double * 2**24).floor(), single.double() * 2**24)


def test_the_extreme_keys_stay_within_the_unit_interval():
    ends = torch.tensor([0, -1, 2**63 - 1, -(2**63)])
    for dtype in (torch.float32, torch.float64):
        u = to_uniform(ends, dtype)
        assert u[0] == 0.0
        assert 0.999 < u[1] < 1.0
        assert u[2] < 0.5 == u[3]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_number_does_not_depend_on_the_batch_the_row_or_what_else_is_drawn(dtype):
    steps = torch.arange(64) * 7
    together = uniform(KEYS[:64], steps, 9, PURPOSES, dtype)
    for row in (0, 13, 63):
        alone = uniform(KEYS[row : row + 1], int(steps[row]), 9, PURPOSES, dtype)
        assert torch.equal(alone[0], together[row])
    fewer = uniform(KEYS[:64], steps, 4, [Purpose.FAULT], dtype)
    assert torch.equal(fewer[..., 0], together[:, :4, PURPOSES.index(Purpose.FAULT)])


def test_normal_numbers_have_the_moments_of_the_normal_distribution():
    noise = int(Purpose.NOISE)
    z = normal(KEYS, 0, 2, [noise, noise + 1], torch.float64).flatten()
    error = 1.0 / math.sqrt(z.numel())
    assert abs(z.mean()) < 5 * error
    assert abs(z.var() - 1.0) < 5 * math.sqrt(2.0) * error
    assert abs((z**3).mean()) < 5 * math.sqrt(15.0) * error
    assert abs((z**4).mean() - 3.0) < 5 * math.sqrt(96.0) * error
    assert torch.isfinite(z).all()
