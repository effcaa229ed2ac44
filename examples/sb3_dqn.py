"""stable-baselines3's DQN on the highway, unchanged, and its policy beside MOBIL on the same
episodes.

Run it with ``python examples/sb3_dqn.py`` (needs ``pip install stable-baselines3``); a short
training by default, more with ``python examples/sb3_dqn.py 200000``.
"""

from __future__ import annotations

import sys

import gymnasium
import torch
from stable_baselines3 import DQN
from tensordict.nn import TensorDictModule

import ganlane


class Greedy(torch.nn.Module):
    """The best action of a Q-network [N], from observations [N, D]."""

    def __init__(self, q_net):
        super().__init__()
        self.q_net = q_net

    def forward(self, observation):
        """The action [N] int64."""
        return self.q_net(observation).argmax(dim=1)


def main(decisions=2_000, episodes=20, goal_m=1000.0):
    """Train on one highway, then evaluate on a batch of them."""
    torch.manual_seed(0)
    env = gymnasium.make("ganlane/Highway-v0", traffic="idm_mobil", goal_m=goal_m)
    model = DQN("MlpPolicy", env, learning_starts=decisions // 4, gamma=0.98, train_freq=4, seed=0)
    model.learn(decisions)
    finished = [episode["r"] for episode in model.ep_info_buffer]
    print(
        f"{model.num_timesteps} decisions, mean return of the last {len(finished)} episodes "
        f"{mean(finished):.1f}"
    )
    policy = TensorDictModule(Greedy(model.q_net), in_keys=["observation"], out_keys=["action"])
    sb3 = ganlane.Driver("sb3_dqn", policy)
    table = ganlane.api.evaluate(
        [sb3, "mobil", "random_legal"], ["idm_mobil"], episodes, goal_m=goal_m
    )
    print(table.select("agent", "episodes", "goal", "hard_crash", "mean_reward"))


def mean(numbers):
    """Their mean; 0 for none."""
    return sum(numbers) / max(len(numbers), 1)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
