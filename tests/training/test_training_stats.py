"""Episode statistics: returns, rates, and Q-values against realised returns."""

import pytest
import torch
from tensordict import TensorDict

from ganlane.training.stats import EpisodeStats


def step(reward, done, distance=0.0, lane_changes=0, action=0, value=None, **events):
    no = [False] * len(reward)
    after = {
        "reward": torch.tensor(reward)[:, None],
        "done": torch.tensor(done)[:, None],
        "events": {
            name: torch.tensor(events.get(name, no))[:, None] for name in ("hard_crash", "goal")
        },
        "ego": {
            "distance": torch.full((len(reward),), distance),
            "lane_changes": torch.full((len(reward),), lane_changes),
        },
    }
    written = {} if value is None else {"chosen_action_value": torch.tensor(value)[:, None]}
    written |= {"action": torch.full((len(reward),), action), "next": after}
    return TensorDict(written, [len(reward)])


def test_returns_and_rates_are_those_of_the_finished_episodes():
    stats = EpisodeStats(2, 3, gamma=0.5)
    crash = {"hard_crash": [True, False], "lane_changes": 3, "action": 2}
    goal = {"goal": [False, True], "lane_changes": 1}
    stats.step(step([1.0, 10.0], [False, False], distance=500.0))
    stats.step(step([2.0, 20.0], [True, False], distance=1000.0, **crash))
    stats.step(step([4.0, 40.0], [True, True], distance=1000.0, **goal))
    row = stats.read()
    assert row["episodes"] == 3
    assert row["mean_return"] == pytest.approx((3 + 4 + 70) / 3)
    assert row["mean_discounted_return"] == pytest.approx((1 + 1 + 4 + 10 + 10 + 10) / 3)
    assert row["crash_rate"] == row["goal_rate"] == row["action_2_share"] == pytest.approx(1 / 3)
    assert row["lane_changes_per_km"] == pytest.approx(5 / 3)


def test_what_an_environment_or_a_policy_does_not_write_has_no_column():
    stats = EpisodeStats(1, 2, gamma=1.0)
    written = step([1.0], [True]).select("action", ("next", "reward"), ("next", "done"))
    stats.step(written)
    means = {"mean_return", "mean_discounted_return", "mean_return_to_go"}
    assert set(stats.read()) == {"episodes", "action_0_share", "action_1_share", *means}


def test_returns_to_go_and_values_are_averaged_over_the_decisions_of_finished_episodes():
    stats = EpisodeStats(2, 2, gamma=0.5)
    for reward, value in ((1.0, 2.0), (2.0, 4.0), (4.0, 6.0)):
        stats.step(step([reward, 9.0], [reward == 4.0, False], value=[value, 0.0]))
    row = stats.read()
    # From the three decisions: 1 + 2/2 + 4/4, 2 + 4/2, 4.
    assert row["mean_return_to_go"] == pytest.approx((3.0 + 4.0 + 4.0) / 3.0)
    assert row["mean_value"] == pytest.approx(4.0)
