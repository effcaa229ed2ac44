"""SAC and PPO of stable-baselines3 accelerate, brake and steer on an on-ramp that ends.

``python examples/sb3_sac_merge.py`` trains SAC for 40,000 decisions, two minutes on one core, and
compares the result with MOBIL on the same episodes. ``... 1500000 PPO 100 256 0 3000000`` trains
PPO on 256 roads at once with seed 0, then for 3,000,000 decisions among people and drivers who
differ: so agent_merge was made. PPO's model goes to ``outputs/sb3/merge``, where
``ganlane benchmark suite=merge-v1 outputs/sb3/merge`` takes all that are there. Needs
``pip install 'ganlane[sb3]'``.
"""

import sys

import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize

import ganlane.sb3

SCENE = {"env": "merge", "goal_m": 800.0}
#: As strong as the acceleration: with the default, 8 m/s2, random actions brake on the whole, and
#: the first thing that is learned is to stand.
ACTIONS = {"form": "continuous", "strongest_braking": 3.0}
#: Of the roads on which PPO goes on. Who begins there learns to stand: it is safe among people.
MIXTURE = {
    "name": "mixed",
    "shares": {"idm_mobil": 1, "idm_random": 1, "human": 2},
    "blind_share": 0.05,
}


def roads(traffic, num_envs, seed):
    """Roads side by side; crashes make the rewards' scale large."""
    options = {"actions": ACTIONS, "observation": "road_view", **SCENE}
    env = ganlane.sb3.make_vec_env(traffic, num_envs=int(num_envs), seed=seed, **options)
    return VecNormalize(env, norm_obs=False, gamma=0.98, clip_reward=1e9)


def ppo(env, seed, learning_rate, ent_coef):
    """Its learning rate falls to 0."""
    more = {"n_steps": 64, "batch_size": 2048, "n_epochs": 5, "gae_lambda": 0.9, "gamma": 0.98}
    more |= {"policy_kwargs": {"log_std_init": -0.7}, "ent_coef": ent_coef, "seed": seed}
    return PPO("MlpPolicy", env, learning_rate=lambda left: learning_rate * left, **more)


def main(decisions="40000", algorithm="SAC", episodes="100", num_envs="16", seed="0", further="0"):
    """Train, then evaluate."""
    seed = int(seed)
    torch.set_num_threads(1)  # small networks: a second thread only costs
    env = roads("idm_mobil", num_envs, seed)
    if algorithm == "SAC":
        more = {"learning_starts": 2000, "gradient_steps": 8, "learning_rate": 1e-3}
        more |= {"train_freq": 1, "policy_kwargs": {"net_arch": [64, 64]}}
        model = SAC("MlpPolicy", env, gamma=0.98, **more, seed=seed)
    else:
        model = ppo(env, seed, 1e-3, 0.005)
    model.learn(int(decisions))
    if int(further):
        weights = model.policy.state_dict()
        model = ppo(roads(MIXTURE, num_envs, seed), seed, 3e-4, 0.0)
        model.policy.load_state_dict(weights)
        model.learn(int(further))
    driver = ganlane.sb3.driver(model)
    if algorithm == "PPO":
        driver.save(f"outputs/sb3/merge/PPO_merge_{seed}.zip")
    table = ganlane.api.evaluate([driver, "mobil"], ["idm_mobil"], int(episodes), **SCENE)
    print(table.select("agent", "goal", "hard_crash", "out_of_road", "timeout", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
