"""stable-baselines3's PPO on 64 highways at once, and its policy compared with MOBIL on the same episodes.

Run it with ``python examples/sb3_ppo.py`` (needs ``pip install 'ganlane[sb3]'``); more training with
``python examples/sb3_ppo.py 1000000``; with sb3-contrib's MaskablePPO behind the action mask:
``python examples/sb3_ppo.py 200000 safe``.
"""

import sys

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

import ganlane
import ganlane.sb3


def main(decisions="200000", mask="none", episodes="100", goal_m="5000"):
    """Train, then evaluate."""
    torch.set_num_threads(1)  # small networks: a second thread only costs
    options = {"mask": mask, "goal_m": float(goal_m)}
    env = ganlane.sb3.make_vec_env("idm_mobil", num_envs=64, seed=0, **options)
    network = {"net_arch": [256, 256], "activation_fn": torch.nn.ReLU}
    algorithm = PPO if mask == "none" else MaskablePPO
    model = algorithm("MlpPolicy", env, n_steps=64, batch_size=512, gamma=0.98, policy_kwargs=network, seed=0)
    model.learn(int(decisions), progress_bar=False)
    table = ganlane.api.evaluate([ganlane.sb3.driver(model), "mobil"], ["idm_mobil"], int(episodes), **options)
    print(table.select("agent", "episodes", "goal", "hard_crash", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
