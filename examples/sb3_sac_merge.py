"""SAC of stable-baselines3 accelerates, brakes and steers on an on-ramp that ends.

``python examples/sb3_sac_merge.py`` trains for 40,000 decisions, two minutes on one core, and
compares the result with MOBIL on the same episodes; ``... 1500000 PPO 100 256`` trains PPO on 256
roads at once, and a fifth word is its seed. PPO's model goes to ``outputs/sb3``, where
``ganlane benchmark suite=merge-v1 outputs/sb3/PPO_merge_0.zip`` takes it. Needs
``pip install 'ganlane[sb3]'``.
"""

import sys

import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize

import ganlane.sb3


def main(decisions="40000", algorithm="SAC", episodes="100", num_envs="16", seed="0"):
    """Train, then evaluate."""
    seed = int(seed)
    torch.set_num_threads(1)  # small networks: a second thread only costs
    scene = {"env": "merge", "goal_m": 800.0}
    # As strong as the acceleration: with the default, 8 m/s2, random actions brake on the whole,
    # and the first thing that is learned is to stand.
    actions = {"form": "continuous", "strongest_braking": 3.0}
    options = {"actions": actions, "observation": "road_view", **scene}
    env = ganlane.sb3.make_vec_env("idm_mobil", num_envs=int(num_envs), seed=seed, **options)
    # crashes make the rewards' scale large
    env = VecNormalize(env, norm_obs=False, gamma=0.98, clip_reward=1e9)
    if algorithm == "SAC":
        more = {"learning_starts": 2000, "gradient_steps": 8, "learning_rate": 1e-3}
        more |= {"train_freq": 1, "policy_kwargs": {"net_arch": [64, 64]}}
        model = SAC("MlpPolicy", env, gamma=0.98, **more, seed=seed)
    else:
        more = {"n_steps": 64, "batch_size": 2048, "n_epochs": 5, "gae_lambda": 0.9}
        more |= {"learning_rate": lambda left: 1e-3 * left, "ent_coef": 0.005}
        more |= {"policy_kwargs": {"log_std_init": -0.7}}
        model = PPO("MlpPolicy", env, gamma=0.98, **more, seed=seed)
    model.learn(int(decisions))
    driver = ganlane.sb3.driver(model)
    if algorithm == "PPO":
        driver.save(f"outputs/sb3/PPO_merge_{seed}.zip")
    table = ganlane.api.evaluate([driver, "mobil"], ["idm_mobil"], int(episodes), **scene)
    print(table.select("agent", "goal", "hard_crash", "out_of_road", "timeout", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
