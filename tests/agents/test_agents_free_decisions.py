"""The window of free decisions against a brute-force loop over episodes with lane changes and ends."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from ganlane.agents import NStepWindow, Rainbow, RainbowConfig
from ganlane.agents.free_decisions import FreeDecisionWindow
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.traffic import IdmTraffic

GAMMA = 0.9


def recorded(steps, environments, seed, ends=0.1, changes=0.4):
    """Steps with random ends and lane changes of random length; no two observations are the same."""
    generator = torch.Generator().manual_seed(seed)

    def draw(share):
        return torch.rand(environments, 1, generator=generator) < share

    direction = torch.zeros(environments, dtype=torch.int64)
    left = torch.zeros(environments, dtype=torch.int64)
    current, result = torch.arange(environments)[:, None] / 100, []
    for number in range(1, steps + 1):
        terminated, truncated = draw(ends), draw(ends)
        done = terminated | truncated
        length = torch.randint(1, 7, (environments,), generator=generator)
        left = torch.where(direction == 0, torch.where(draw(changes)[:, 0], length, 1), left) - 1
        after_direction = torch.where(left > 0, torch.where(direction == 0, 1 - 2 * (length % 2), direction), 0)
        following = number + torch.arange(environments)[:, None] / 100
        after = {
            "observation": following,
            "reward": torch.randn(environments, 1, generator=generator),
            "terminated": terminated,
            "truncated": truncated,
            "done": done,
            "ego": {"change_direction": after_direction},
        }
        action = torch.randint(0, 3, (environments,), generator=generator)
        before = {"observation": current, "action": action, "ego": {"change_direction": direction}}
        result.append(TensorDict({**before, "next": after}, [environments]))
        current = torch.where(done, following + 0.5, following)
        direction = torch.where(done[:, 0], 0, after_direction)
        left = torch.where(done[:, 0], 0, left)
    return result


def brute_force(steps, start, row, n):
    """Return, length, next observation and terminated of the decision ``start``; None while it is not complete."""
    reward = 0.0
    for length, step in enumerate(steps[start:], start=1):
        after = step["next"]
        reward += GAMMA ** (length - 1) * float(after["reward"][row])
        if after["done"][row] or (length >= n and after["ego", "change_direction"][row] == 0):
            return reward, length, after["observation"][row], after["terminated"][row]
    return None


def by_first_observation(window, steps):
    """Every transition by its first observation, and the step that gave it."""
    found = {}
    for number, step in enumerate(steps):
        transition = window.push(step)
        for one in [] if transition is None else transition:
            assert float(one["observation"]) not in found
            found[float(one["observation"])] = (number, one)
    return found


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5), st.integers(1, 4), st.integers(0, 10_000), st.sampled_from([0.0, 0.1, 0.4]))
def test_each_free_decision_gives_the_transition_of_the_loop(n, environments, seed, ends):
    steps = recorded(30, environments, seed, ends)
    found = by_first_observation(FreeDecisionWindow(n, GAMMA), steps)
    expected = 0
    for start, step in enumerate(steps):
        for row in range(environments):
            free = step["ego", "change_direction"][row] == 0
            result = brute_force(steps, start, row, n) if free else None
            if result is None:
                assert float(step["observation"][row]) not in found
                continue
            reward, length, following, terminated = result
            number, one = found[float(step["observation"][row])]
            expected += 1
            assert number == start + length - 1
            assert one["action"] == step["action"][row]
            assert one["steps_to_next_obs"].item() == length
            assert torch.equal(one["next", "observation"], following)
            assert one["next", "terminated"] == terminated
            torch.testing.assert_close(float(one["next", "reward"]), reward, atol=1e-5, rtol=1e-5)
    assert len(found) == expected


def test_without_lane_changes_the_transitions_are_those_of_the_ordinary_window():
    steps = recorded(30, 3, seed=5, changes=0.0)
    free, ordinary = FreeDecisionWindow(3, GAMMA), NStepWindow(3, GAMMA)
    found = by_first_observation(free, steps)
    seen = by_first_observation(ordinary, steps)
    assert len(seen) == 3 * 28
    for first, (_, transition) in seen.items():
        _, one = found[first]
        assert one["steps_to_next_obs"] == transition["steps_to_next_obs"]
        torch.testing.assert_close(one["next"].to_dict(), transition["next"].to_dict())


def test_shapes_and_types_are_those_of_the_ordinary_window():
    steps = recorded(4, 3, seed=0, ends=0.0, changes=0.0)
    windows = FreeDecisionWindow(2, GAMMA), NStepWindow(2, GAMMA)
    ours, theirs = ([window.push(step) for step in steps][-1] for window in windows)
    assert ours.batch_size == theirs.batch_size
    leaves = [[(key, value.shape, value.dtype) for key, value in td.items(True, True)] for td in (ours, theirs)]
    assert sorted(leaves[0], key=str) == sorted(leaves[1], key=str)


def test_a_lane_change_longer_than_any_window_is_one_decision():
    steps = recorded(40, 1, seed=0, ends=0.0, changes=0.0)
    for i, step in enumerate(steps):
        step["ego", "change_direction"][:] = int(0 < i < 30)
        step["next", "ego", "change_direction"][:] = int(i < 29)
    found = by_first_observation(FreeDecisionWindow(2, GAMMA), steps)
    assert found[0.0][1]["steps_to_next_obs"] == 30
    assert len(found) == 1 + 9


def test_a_saved_window_goes_on_as_if_nothing_had_happened(tmp_path):
    steps = recorded(20, 3, seed=2)
    whole, first, second = (FreeDecisionWindow(3, GAMMA) for _ in range(3))
    expected = [whole.push(step) for step in steps][9:]
    for step in steps[:9]:
        first.push(step)
    torch.save(first.state_dict(), tmp_path / "window.pt")
    second.load_state_dict(torch.load(tmp_path / "window.pt", weights_only=True))
    for wanted, step in zip(expected, steps[9:]):
        given = second.push(step)
        assert (given is None) == (wanted is None)
        assert given is None or (given == wanted).all()


def test_a_fresh_window_can_be_saved_too():
    window = FreeDecisionWindow(3, GAMMA)
    window.load_state_dict(FreeDecisionWindow(3, GAMMA).state_dict())
    assert window.push(recorded(1, 2, seed=0, ends=0.0)[0]) is None


def test_the_window_keeps_its_own_copy():
    steps = recorded(2, 2, seed=1, ends=0.0, changes=0.0)
    window = FreeDecisionWindow(2, GAMMA)
    window.push(steps[0])
    original = steps[0]["observation"].clone()
    steps[0]["observation"].fill_(99.0)
    assert torch.equal(window.push(steps[1])["observation"], original)


def test_in_the_environment_a_command_is_obeyed_just_where_a_transition_starts():
    env = HighwayEnv(IdmTraffic(), num_envs=4)
    td, window = env.reset(), FreeDecisionWindow(1, GAMMA)
    generator, obeyed, started = torch.Generator().manual_seed(0), 0, 0
    for _ in range(12):
        target = td["vehicles", "target_lane"][:, 0]
        legal = torch.where(
            target == 0, 1, torch.where(target == 2, 2, torch.randint(1, 3, (4,), generator=generator))
        )
        step, after = env.step_and_maybe_reset(td.set("action", legal))
        step["observation"], step["next", "observation"] = (
            step["ego", "distance"][:, None],
            step["next", "ego", "distance"][:, None],
        )
        obeyed += int(step["next", "ego", "started_change"].sum())
        transition = window.push(step)
        started += 0 if transition is None else len(transition)
        td = after
    waiting = int(window.pending.active.sum())
    assert obeyed == started + waiting > 4


def test_the_agent_asks_for_it_and_an_environment_without_lane_changes_is_refused():
    assert isinstance(Rainbow(RainbowConfig(), 4).window(), NStepWindow)
    window = Rainbow(RainbowConfig(decide_when_free=True, n_step=2, gamma=0.9), 4).window()
    assert isinstance(window, FreeDecisionWindow)
    assert (window.n, window.gamma) == (2, 0.9)
    step = recorded(1, 2, seed=0)[0].exclude("ego")
    with pytest.raises(UserError, match="decide_when_free"):
        window.push(step)
