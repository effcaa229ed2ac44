"""PPO of stable-baselines3 on 256 highways at once, and its policy compared with MOBIL on the same
episodes.

``python examples/sb3_ppo.py`` trains sb3-contrib's MaskablePPO behind the safe action mask for 3 M
decisions, two minutes on one core. ``python examples/sb3_ppo.py 4500000 none PPO`` trains plain PPO
without a mask; ``... safe PPO`` trains it without one as well and lets it drive behind the mask.
Needs ``pip install 'ganlane[sb3]'``.
"""

import sys

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import ganlane
import ganlane.sb3


def learner(algorithm, env, seed):
    """PPO or MaskablePPO on ``env``, with a learning rate that falls to 0."""
    return algorithm(
        "MlpPolicy",
        env,
        learning_rate=lambda left: 1e-3 * left,
        n_steps=64,
        batch_size=2048,
        n_epochs=5,
        gamma=0.98,
        gae_lambda=0.9,
        ent_coef=0.01,
        policy_kwargs={"net_arch": [128, 128]},
        seed=seed,
    )


def main(
    decisions="3000000",
    mask="safe",
    algorithm="MaskablePPO",
    episodes="100",
    goal_m="5000",
    num_envs="256",
    seed="0",
):
    """Train, then evaluate."""
    torch.set_num_threads(1)  # small networks: a second thread only costs
    options = {"mask": mask, "goal_m": float(goal_m)}
    env = ganlane.sb3.make_vec_env("idm_mobil", num_envs=int(num_envs), seed=int(seed), **options)
    if algorithm == "PPO":
        # crashes make the rewards' scale large
        env = VecNormalize(env, norm_obs=False, gamma=0.98, clip_reward=1e9)
    model = learner({"PPO": PPO, "MaskablePPO": MaskablePPO}[algorithm], env, int(seed))
    model.learn(int(decisions))
    driver = ganlane.sb3.driver(model)
    # For `ganlane benchmark outputs/sb3/MaskablePPO_0.zip`.
    driver.save(f"outputs/sb3/{algorithm}_{seed}.zip")
    drivers = [driver, "mobil"]
    table = ganlane.api.evaluate(drivers, ["idm_mobil"], int(episodes), **options)
    print(table.select("agent", "episodes", "goal", "hard_crash", "mean_reward"))


if __name__ == "__main__":
    main(*sys.argv[1:])
