"""MaskablePPO of sb3-contrib takes the exit: it changes lanes and chooses its speed.

``python examples/sb3_exit.py`` trains it behind the safe mask for 1,500,000 decisions on
``idm_mobil``, then for 3,000,000 among people and drivers who differ, too, in some four minutes of
one core, and compares it with MOBIL on the same episodes: so agent_exit was made. Its model goes to
``outputs/sb3/exit``, where ``ganlane benchmark suite=exit-v1 outputs/sb3/exit`` takes all that are
there. Needs ``pip install 'ganlane[sb3]'``.
"""

import sys

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import VecNormalize

import ganlane.sb3

ROAD = {"env": "exit", "observation": "road_view", "mask": "safe", "actions": "lane_speed"}
#: Of the roads on which it goes on.
MIXTURE = {
    "name": "mixed",
    "shares": {"idm_mobil": 2, "idm_random": 1, "human": 1},
    "blind_share": 0.1,
}


def learner(traffic, num_envs, seed, learning_rate, ent_coef):
    """On roads side by side; its learning rate falls to 0.

    Random actions take the exit in one episode of seven: with a ``ent_coef`` of 0.005 it learned to
    stay in the fast lane.
    """
    env = ganlane.sb3.make_vec_env(traffic, num_envs=int(num_envs), seed=seed, **ROAD)
    # crashes make the rewards' scale large
    env = VecNormalize(env, norm_obs=False, gamma=0.98, clip_reward=1e9)
    more = {"n_steps": 64, "batch_size": 2048, "n_epochs": 5, "gae_lambda": 0.95, "gamma": 0.98}
    more |= {"policy_kwargs": {"net_arch": [128, 128]}, "ent_coef": ent_coef, "seed": seed}
    return MaskablePPO("MlpPolicy", env, learning_rate=lambda left: learning_rate * left, **more)


def main(decisions="1500000", further="3000000", episodes="500", num_envs="256", seed="0"):
    """Train, then evaluate."""
    seed = int(seed)
    torch.set_num_threads(1)  # small networks: a second thread only costs
    model = learner("idm_mobil", num_envs, seed, 1e-3, 0.03)
    model.learn(int(decisions))
    weights = model.policy.state_dict()
    model = learner(MIXTURE, num_envs, seed, 3e-4, 0.0)
    model.policy.load_state_dict(weights)
    model.learn(int(further))
    driver = ganlane.sb3.driver(model)
    driver.save(f"outputs/sb3/exit/PPO_exit_{seed}.zip")
    table = ganlane.api.evaluate(
        [driver, "mobil"], ["idm_mobil", "human"], int(episodes), env="exit"
    )
    print(table.select("agent", "traffic", "goal", "hard_crash", "missed_exit", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
