"""stable-baselines3: the batch is a VecEnv.

Algorithms train on it unchanged, and their policies are evaluated.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest

sb3_contrib = pytest.importorskip("sb3_contrib", reason="the extra sb3 is not installed")

# ruff: noqa: E402 - behind the skip
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize

import ganlane
import ganlane.sb3
from ganlane.errors import UserError
from ganlane.gym.vector import HighwayVectorGym

ROWS = 4
SHORT = {"goal_m": 150.0}
#: Small networks and buffers: a test trains for moments.
QUICK = {
    PPO: {"n_steps": 16, "batch_size": 32},
    sb3_contrib.MaskablePPO: {"n_steps": 16, "batch_size": 32},
    DQN: {"learning_starts": 32, "batch_size": 16, "buffer_size": 500},
}


def short_episodes(**options):
    return ganlane.sb3.make_vec_env("idm", num_envs=ROWS, **{"seed": 0, **SHORT, **options})


def drive(env, steps):
    """Observations, rewards, ends and infos of so many steps in which all rows keep their lanes."""
    env.reset()
    return [env.step(np.zeros(ROWS, dtype=np.int64)) for _ in range(steps)]


def test_observations_and_rewards_are_those_of_the_gymnasium_batch():
    highways = HighwayVectorGym(num_envs=ROWS, traffic="idm", seed=0, **SHORT)
    env = short_episodes()
    assert np.array_equal(env.reset(), highways.reset()[0])
    for action in np.random.default_rng(0).integers(0, 3, (20, ROWS)):
        observation, reward, done, _ = env.step(action)
        expected, expected_reward, terminated, truncated, _ = highways.step(action)
        assert np.array_equal(observation, expected)
        assert np.allclose(reward, expected_reward)
        assert np.array_equal(done, terminated | truncated)


def test_the_info_of_a_row_that_ends_holds_its_statistics_and_its_last_observation():
    steps = drive(short_episodes(), 40)
    ends = [
        (step, row) for step, (_, _, done, _) in enumerate(steps) for row in np.flatnonzero(done)
    ]
    assert ends
    began = dict.fromkeys(range(ROWS), 0)
    for step, row in ends:
        info = steps[step][3][row]
        rewards = [steps[k][1][row] for k in range(began[row], step + 1)]
        assert info["episode"]["r"] == pytest.approx(sum(rewards), abs=1e-4)
        assert info["episode"]["l"] == len(rewards)
        assert info["terminal_observation"].shape == steps[step][0][row].shape
        assert not np.array_equal(info["terminal_observation"], steps[step][0][row])
        assert info["goal"]
        assert not info["TimeLimit.truncated"]
        began[row] = step + 1
    running = [
        info for _, _, done, infos in steps for row, info in enumerate(infos) if not done[row]
    ]
    assert all(info == {} for info in running)


def test_the_info_of_a_time_out_says_so():
    steps = drive(short_episodes(goal_m=5000.0, timeout_s=3.0), 3)
    assert all(info["TimeLimit.truncated"] for info in steps[-1][3])


def test_a_seed_gives_the_same_episodes_again_and_the_next_reset_new_ones():
    env = short_episodes(seed=None)
    env.seed(7)
    first = env.reset()
    second = env.reset()
    assert not np.array_equal(first, second)
    env.seed(7)
    assert np.array_equal(env.reset(), first)
    env.seed(7)
    env.set_options({"episode": ROWS})
    assert np.array_equal(env.reset(), second)


def test_masks_are_given_to_sb3_contrib_by_row():
    env = short_episodes(mask="safe")
    env.reset()
    assert env.has_attr("action_masks")
    masks = np.stack(env.env_method("action_masks"))
    assert masks.shape == (ROWS, 3)
    assert np.array_equal(masks, env.action_masks())
    assert masks[:, 0].all()
    assert np.array_equal(np.stack(env.env_method("action_masks", indices=[2])), masks[2:3])


def test_pictures_of_all_rows_are_tiled():
    env = short_episodes(render_mode="rgb_array")
    env.reset()
    height, width, _ = env.get_images()[0].shape
    assert env.render().shape == (2 * height, 2 * width, 3)
    with pytest.raises(UserError, match="render_mode"):
        short_episodes().get_images()


def test_attributes_are_those_of_the_batch_and_cannot_be_set():
    env = short_episodes()
    assert env.get_attr("num_envs") == [ROWS] * ROWS
    assert not env.has_attr("no_such_thing")
    assert env.env_is_wrapped(Monitor) == [True] * ROWS
    assert env.env_is_wrapped(VecNormalize) == [False] * ROWS
    with pytest.raises(UserError, match="make_vec_env"):
        env.set_attr("lanes", 4)
    with pytest.raises(UserError, match="call one of them"):
        env.env_method("no_such_method")
    with pytest.raises(UserError, match="seed=-1"):
        env.seed(-1)
    env.close()


@pytest.mark.parametrize("algorithm", QUICK, ids=lambda kind: kind.__name__)
def test_the_algorithm_trains_unchanged_and_its_policy_can_be_evaluated(algorithm):
    env = short_episodes(mask="safe")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = algorithm("MlpPolicy", env, seed=0, device="cpu", **QUICK[algorithm]).learn(128)
        if algorithm is not sb3_contrib.MaskablePPO:
            returns, lengths = evaluate_policy(
                model, short_episodes(), n_eval_episodes=4, return_episode_rewards=True
            )
            assert len(returns) == len(lengths) == 4
    assert model.ep_info_buffer
    driver = ganlane.sb3.driver(model)
    table = ganlane.api.evaluate([driver, "mobil"], ["idm"], 3, mask="safe", **SHORT)
    assert table["agent"].to_list() == [algorithm.__name__.lower(), "mobil"]
    assert table["episodes"].to_list() == [3, 3]
    assert table["out_of_road"].to_list() == [0, 0]
