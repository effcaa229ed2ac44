"""SAC of stable-baselines3 accelerates, brakes and steers on an on-ramp that ends.

``python examples/sb3_sac_merge.py`` trains for 30,000 decisions and compares the result with MOBIL;
``... 100000 PPO`` trains PPO. A starting point, not a tuned recipe: a run of this length with a
quarter of the updates learned to stand still. Needs ``pip install 'ganlane[sb3]'``.
"""

import sys

import torch
from stable_baselines3 import PPO, SAC

import ganlane.sb3


def main(decisions="30000", algorithm="SAC", episodes="100", num_envs="16"):
    """Train, then evaluate."""
    torch.set_num_threads(1)  # small networks: a second thread only costs
    scene = {"env": "merge", "goal_m": 800.0}
    options = {"actions": "continuous", "observation": "road_view", **scene}
    env = ganlane.sb3.make_vec_env("idm_mobil", num_envs=int(num_envs), seed=0, **options)
    if algorithm == "SAC":
        more = {"learning_starts": 2000, "train_freq": 1, "gradient_steps": 16, "batch_size": 128}
        more |= {"policy_kwargs": {"net_arch": [64, 64]}, "learning_rate": 1e-3}
        model = SAC("MlpPolicy", env, gamma=0.99, **more, seed=0)
    else:
        model = PPO("MlpPolicy", env, gamma=0.98, n_steps=64, batch_size=256, seed=0)
    model.learn(int(decisions))
    drivers = [ganlane.sb3.driver(model), "mobil"]
    table = ganlane.api.evaluate(drivers, ["idm_mobil"], int(episodes), **scene)
    print(table.select("agent", "goal", "hard_crash", "out_of_road", "timeout", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
