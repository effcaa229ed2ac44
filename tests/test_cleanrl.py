"""What CleanRL's ``ppo.py`` asks of an environment.

The script is in CleanRL's repository, not in its package. Here is how it makes environments, acts,
and reads ends and infos.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np

ENV_ID = "ganlane:ganlane/Highway-v0"
ROWS = 2
STEPS = 64


def make_env():
    return gym.wrappers.RecordEpisodeStatistics(gym.make(ENV_ID, goal_m=60.0))


def test_its_ppo_finds_what_it_reads():
    envs = gym.vector.SyncVectorEnv([make_env for _ in range(ROWS)])
    rng = np.random.default_rng(0)
    returns = []
    shape = (ROWS, *envs.single_observation_space.shape)
    observation, _ = envs.reset(seed=1)
    for _ in range(STEPS):
        assert observation.shape == shape
        action = rng.integers(envs.single_action_space.n, size=ROWS)
        observation, reward, terminations, truncations, infos = envs.step(action)
        assert np.isfinite(reward).all()
        assert np.logical_or(terminations, truncations).shape == (ROWS,)
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
    envs.close()
    # The goal's 100, or a crash's or the verge's -100.
    assert len(returns) >= 10
    assert {round(value, -2) for value in returns} <= {-100.0, 0.0, 100.0}
