"""stable-baselines3's DQN on the highway, unchanged, and its policy beside MOBIL on the same
episodes.

Run it with ``python examples/sb3_dqn.py`` (needs ``pip install stable-baselines3``); a short
training by default, more with ``python examples/sb3_dqn.py 200000``. The policy is stored for
``ganlane benchmark outputs/sb3/DQN_0.zip``.
"""

from __future__ import annotations

import sys

import gymnasium
import torch
from stable_baselines3 import DQN

import ganlane
import ganlane.sb3


def main(decisions=2_000, episodes=20, goal_m=1000.0, seed=0):
    """Train on one highway, then evaluate on a batch of them."""
    torch.set_num_threads(1)  # small networks: a second thread only costs
    env = gymnasium.make("ganlane/Highway-v0", traffic="idm_mobil", goal_m=goal_m)
    options = {"learning_starts": decisions // 4, "gamma": 0.98, "train_freq": 4, "seed": seed}
    model = DQN("MlpPolicy", env, **options)
    model.learn(decisions)
    finished = [episode["r"] for episode in model.ep_info_buffer]
    print(
        f"{model.num_timesteps} decisions, mean return of the last {len(finished)} episodes "
        f"{mean(finished):.1f}"
    )
    driver = ganlane.sb3.driver(model, "sb3_dqn")
    driver.save(f"outputs/sb3/DQN_{seed}.zip")
    drivers = [driver, "mobil", "random_legal"]
    table = ganlane.api.evaluate(drivers, ["idm_mobil"], episodes, goal_m=goal_m)
    print(table.select("agent", "episodes", "goal", "hard_crash", "mean_reward"))


def mean(numbers):
    """Their mean; 0 for none."""
    return sum(numbers) / max(len(numbers), 1)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
