"""Given episodes are run to their own ends, whatever the batch size."""

from __future__ import annotations

import polars as pl
import pytest
import torch
from evaluation_toy_env import ToyEnv, always, length, reason
from hypothesis import given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, check_env_specs, exploration_type

from ganlane.errors import UserError
from ganlane.evaluation import run_episodes


def test_the_toy_environment_is_a_proper_one():
    check_env_specs(ToyEnv(3))


def test_each_row_tells_what_the_episode_was():
    frame = run_episodes(ToyEnv(4), always(1), range(10), seed=5)
    assert frame["episode"].to_list() == list(range(10))
    assert frame["seed"].to_list() == [5] * 10
    for row in frame.iter_rows(named=True):
        decisions = length(5, row["episode"])
        goal = 100.0 if reason(row["episode"]) == "goal" else 0.0
        assert row["reason"] == reason(row["episode"])
        assert row["decisions"] == row["lane_changes"] == decisions
        assert row["reward_speed"] == pytest.approx(decisions * (row["episode"] + 1))
        assert row["reward_goal"] == goal
        assert row["reward"] == pytest.approx(row["reward_speed"] + goal)
        assert row["soft_crash"] == decisions // 3
        assert row["soft_crash_behind"] == 2 * (decisions // 3)
        assert row["had_soft_crash"] == (decisions >= 3)
        assert row["distance_m"] == 20.0 * decisions
        assert row["duration_s"] == pytest.approx(decisions)
        assert row["mean_speed_mps"] == pytest.approx(20.0)


@settings(max_examples=15, deadline=None)
@given(
    batch=st.integers(1, 7),
    episodes=st.lists(st.integers(0, 10**9), min_size=1, max_size=12, unique=True),
    seed=st.integers(0, 10**6),
)
def test_the_batch_size_makes_no_difference(batch, episodes, seed):
    alone = [run_episodes(ToyEnv(1), always(0), [episode], seed) for episode in episodes]
    assert_frame_equal(run_episodes(ToyEnv(batch), always(0), episodes, seed), pl.concat(alone))


def test_short_episodes_do_not_push_out_long_ones():
    # Rows that end early are reset and drive on; nothing of what follows may be counted.
    frame = run_episodes(ToyEnv(8), always(1), range(8), seed=0)
    assert frame["episode"].to_list() == list(range(8))
    assert frame["decisions"].to_list() == [length(0, e) for e in range(8)]


def test_progress_counts_up_to_all_episodes():
    seen = []
    run_episodes(ToyEnv(4), always(0), range(6), seed=0, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == sorted(seen)
    assert seen[-1] == (6, 6)


def test_the_policy_acts_deterministically_and_without_gradients():
    modes = set()

    def look(step):
        modes.add((exploration_type(), torch.is_grad_enabled()))
        return torch.zeros_like(step)

    run_episodes(ToyEnv(2), TensorDictModule(look, in_keys=["step"], out_keys=["action"]), range(2), seed=0)
    assert modes == {(ExplorationType.DETERMINISTIC, False)}


def test_an_end_that_the_environment_does_not_name_is_called_other():
    class Nameless(ToyEnv):
        def _step(self, tensordict):
            after = super()._step(tensordict)
            after["events", "goal"].zero_()
            return after

    assert run_episodes(Nameless(1), always(0), [0, 1], seed=0)["reason"].to_list() == ["other", "hard_crash"]


def test_no_episodes_is_a_users_mistake():
    with pytest.raises(UserError, match="episodes"):
        run_episodes(ToyEnv(2), always(0), [], seed=0)
