"""Prioritised sampling: the distribution, the weights, the generator, saving."""

import numpy as np
import pytest
import torch
from agents_small import transitions
from scipy import stats  # scikit-learn, a dependency, brings it along

from ganlane.agents import RainbowConfig
from ganlane.agents.replay import make_replay


def buffer(rows=200, seed=0, **options):
    config = RainbowConfig(capacity=256, batch_size=128, warmup=128, **options)
    result = make_replay(config, torch.Generator().manual_seed(seed))
    result.extend(transitions(1, rows))
    return result


def counts(replay):
    drawn = torch.cat([replay.sample()["index"] for _ in range(400)])
    return torch.bincount(drawn, minlength=200).numpy()


def test_items_are_drawn_in_proportion_to_their_priority_to_the_alpha():
    replay = buffer(alpha=0.6)
    priority = torch.rand(200, generator=torch.Generator().manual_seed(1)) * 5 + 0.1
    priority[17] = 0.0  # eps alone
    replay.update_priority(torch.arange(200), priority)
    share = ((priority.double() + 1e-8) ** 0.6).numpy()
    seen = counts(replay)
    assert seen[17] < 5
    seen, share = np.delete(seen, 17), np.delete(share, 17)
    assert stats.chisquare(seen, share / share.sum() * seen.sum()).pvalue > 0.001


def test_without_priorities_all_items_are_drawn_alike_and_nothing_outside_the_filled_part():
    seen = counts(buffer(rows=65, prioritised=False))
    assert seen[65:].sum() == 0
    assert stats.chisquare(seen[:65]).pvalue > 0.001


def test_importance_weights_are_those_of_schaul_over_the_largest_of_the_batch():
    replay = buffer(alpha=0.5, beta_start=0.7)
    priority = torch.linspace(0.1, 9.0, 200)
    replay.update_priority(torch.arange(200), priority)
    drawn = replay.sample()
    share = (priority + 1e-8) ** 0.5
    weight = (200 * share / share.sum())[drawn["index"]] ** -0.7
    expected = weight / weight.max()
    torch.testing.assert_close(drawn["priority_weight"], expected, atol=1e-5, rtol=1e-5)


def test_a_new_item_has_the_largest_priority_seen():
    replay = buffer(rows=100)
    low = torch.full((100,), 0.01)
    replay.update_priority(torch.arange(100), low)
    replay.update_priority(torch.tensor([3]), torch.tensor([7.0]))
    replay.update_priority(torch.tensor([3]), low[:1])
    replay.extend(transitions(1, 100))
    priorities = replay.sampler.priorities.view(-1)[:200]
    expected = torch.cat((low, low * 700.0)) ** 0.5
    torch.testing.assert_close(priorities, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("prioritised", [True, False])
def test_draws_come_from_the_buffers_own_generator(prioritised):
    state = torch.get_rng_state()
    numpy_state = np.random.get_state()[1].copy()  # noqa: NPY002
    first, second, other = (
        buffer(prioritised=prioritised, seed=seed).sample()["index"] for seed in (4, 4, 5)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), state)
    assert (np.random.get_state()[1] == numpy_state).all()  # noqa: NPY002
