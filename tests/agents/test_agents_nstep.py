"""The n-step window against a brute-force loop over episodes."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from ganlane.agents.n_step import NStepWindow


def recorded(steps, environments, seed):
    """Steps with random ends.

    The observation is a serial number, and the one after a reset is another.
    """
    generator = torch.Generator().manual_seed(seed)
    current = torch.zeros(environments, 1)
    result = []
    for serial in range(1, steps + 1):
        terminated, truncated = torch.rand(2, environments, 1, generator=generator) < 0.2
        following = serial + torch.arange(environments)[:, None] / 100
        after = {
            "observation": following,
            "reward": torch.randn(environments, 1, generator=generator),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        action = torch.randint(0, 3, (environments,), generator=generator)
        step = {"observation": current, "action": action, "next": after}
        result.append(TensorDict(step, [environments]))
        current = torch.where(after["done"], following + 0.5, following)
    return result


def brute_force(steps, start, row, n, gamma):
    """Reward, length, last observation and end of the steps from ``start``, each [1]."""
    reward = torch.zeros(1)
    for length, step in enumerate(steps[start : start + n], 1):
        after = step["next"][row]
        reward += gamma ** (length - 1) * after["reward"]
        if after["done"]:
            break
    return reward, torch.tensor([float(length)]), after["observation"], after["terminated"]


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 5), st.integers(1, 4), st.integers(0, 10_000))
def test_each_transition_equals_the_loop_over_its_own_steps(n, environments, seed):
    gamma = 0.9
    steps = recorded(20, environments, seed)
    window = NStepWindow(n, gamma)
    transitions = [window.push(step) for step in steps]
    assert all(t is None for t in transitions[: n - 1])
    for start, transition in enumerate(transitions[n - 1 :]):
        expected = [brute_force(steps, start, row, n, gamma) for row in range(environments)]
        following = transition["next"]
        actual = [following["reward"], transition["steps_to_next_obs"]]
        actual += [following["observation"], following["terminated"]]
        torch.testing.assert_close(actual, list(map(torch.stack, zip(*expected))))
        for name in ("observation", "action"):
            assert torch.equal(transition[name], steps[start][name])


def test_the_window_keeps_its_own_copy():
    steps = recorded(2, 2, 2)
    window = NStepWindow(2, 0.9)
    window.push(steps[0])
    original = steps[0]["observation"].clone()
    steps[0]["observation"].fill_(99.0)
    assert torch.equal(window.push(steps[1])["observation"], original)
