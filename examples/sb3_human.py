"""MaskablePPO of sb3-contrib among drivers who behave like people: so agent_human was made.

``python examples/sb3_human.py`` trains it behind the mask that looks ahead for 4,000,000 decisions
on ``idm_mobil``, then for 8,000,000 among a mixture of drivers, a tenth of whom do not see it, in
some seventeen minutes of one core, and compares it with the egoistic MOBIL on the same episodes.
Its model goes to ``outputs/sb3/human``. Needs ``pip install 'ganlane[sb3]'``.
"""

import sys

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import VecNormalize

import ganlane.sb3

ROAD = {"observation": "road_view", "mask": "foresight"}
#: Among whom it goes on.
MIXTURE = {
    "name": "mixed",
    "shares": {"idm_mobil": 1, "idm_random": 1, "human": 2, "gan_calibrated": 1},
    "blind_share": 0.1,
}


def learner(traffic, num_envs, seed, learning_rate, ent_coef):
    """On roads side by side; its learning rate falls to 0."""
    env = ganlane.sb3.make_vec_env(traffic, num_envs=num_envs, seed=seed, **ROAD)
    # crashes make the rewards' scale large
    env = VecNormalize(env, norm_obs=False, gamma=0.99, clip_reward=1e9)
    more = {"n_steps": 64, "batch_size": 2048, "n_epochs": 5, "gae_lambda": 0.95, "gamma": 0.99}
    more |= {"policy_kwargs": {"net_arch": [128, 128]}, "ent_coef": ent_coef, "seed": seed}
    return MaskablePPO("MlpPolicy", env, learning_rate=lambda left: learning_rate * left, **more)


def main(decisions="4000000", further="8000000", episodes="500", num_envs="256", seed="0"):
    """Train, then evaluate."""
    rows, seed = int(num_envs), int(seed)
    torch.set_num_threads(1)  # small networks: a second thread only costs
    model = learner("idm_mobil", rows, seed, 1e-3, 0.01)
    model.learn(int(decisions))
    weights = model.policy.state_dict()
    # a multiple of the shares' sum: every row keeps its traffic
    rows -= rows % sum(MIXTURE["shares"].values())
    model = learner(MIXTURE, rows, seed, 3e-4, 0.0)
    model.policy.load_state_dict(weights)
    model.learn(int(further))
    driver = ganlane.sb3.driver(model)
    driver.save(f"outputs/sb3/human/PPO_human_{seed}.zip")
    # the episodes kept for choosing among trainings
    table = ganlane.api.evaluate(
        [driver, "mobil_egoistic"], list(MIXTURE["shares"]), int(episodes), stream="select"
    )
    print(table.select("agent", "traffic", "goal", "hard_crash", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
