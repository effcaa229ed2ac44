"""CleanRL's ``ppo.py`` on the highway.

The script is in CleanRL's repository, not in its package. Here is its form since it uses gymnasium
(commit b5fb801, for gymnasium 0.29): how it makes environments, acts, reads ends and infos, and
updates; shortened, in our words.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Categorical

ENV_ID = "ganlane:ganlane/Highway-v0"
GAMMA, LAMBDA, CLIP, ROWS, STEPS = 0.99, 0.95, 0.2, 2, 64


def make_env():
    return gym.wrappers.RecordEpisodeStatistics(gym.make(ENV_ID, goal_m=100.0))


def one_by_one():
    """As the script makes them; gymnasium 1 resets a row in the step after its end."""
    return gym.vector.SyncVectorEnv([make_env for _ in range(ROWS)])


def as_a_batch():
    """The faster replacement."""
    envs = gym.make_vec(ENV_ID, num_envs=ROWS, goal_m=100.0, autoreset_mode="next_step")
    return gym.wrappers.vector.RecordEpisodeStatistics(envs)


def ended_returns(infos):
    """Returns in the form of gymnasium 0.29, which the script reads (``final_info``), or of 1.x
    (arrays).
    """
    if "final_info" in infos:
        return [
            float(info["episode"]["r"])
            for info in infos["final_info"]
            if info and "episode" in info
        ]
    return infos["episode"]["r"][infos["_episode"]].tolist() if "episode" in infos else []


def layers(size, out, scale):
    made = [nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, out)]
    for layer, gain in zip(made[::2], (2**0.5, 2**0.5, scale)):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*made)


def train(envs, iterations):
    """Update an agent so many times.

    The losses, the returns of the episodes, and how far the weights moved.
    """
    assert isinstance(envs.single_action_space, gym.spaces.Discrete)
    shape = envs.single_observation_space.shape
    size, choices = int(np.prod(shape)), int(envs.single_action_space.n)
    critic, actor = layers(size, 1, 1.0), layers(size, choices, 0.01)
    weights = [*critic.parameters(), *actor.parameters()]
    first = [weight.detach().clone() for weight in weights]
    optimiser = torch.optim.Adam(weights, lr=2.5e-4, eps=1e-5)
    losses, returns = [], []
    next_obs, _ = envs.reset(seed=1)
    next_obs, next_done = torch.Tensor(next_obs), torch.zeros(ROWS)
    for _ in range(iterations):
        steps = []
        for _ in range(STEPS):
            with torch.no_grad():
                chosen = Categorical(logits=actor(next_obs))
                action = chosen.sample()
                before = (
                    next_obs,
                    next_done,
                    action,
                    chosen.log_prob(action),
                    critic(next_obs).flatten(),
                )
            next_obs, reward, terminations, truncations, infos = envs.step(action.cpu().numpy())
            steps.append((*before, torch.tensor(reward).view(-1).float()))
            next_obs, next_done = (
                torch.Tensor(next_obs),
                torch.Tensor(np.logical_or(terminations, truncations)),
            )
            returns += ended_returns(infos)
        obs, dones, actions, logprobs, values, rewards = map(torch.stack, zip(*steps))
        advantages, last = torch.zeros_like(rewards), 0.0
        with torch.no_grad():
            following = torch.cat((values[1:], critic(next_obs).reshape(1, -1)))
            going_on = 1.0 - torch.cat((dones[1:], next_done[None]))
            for step in reversed(range(STEPS)):
                delta = rewards[step] + GAMMA * following[step] * going_on[step] - values[step]
                advantages[step] = last = delta + GAMMA * LAMBDA * going_on[step] * last
        flat, advantage, target = (
            obs.reshape(-1, *shape),
            advantages.reshape(-1),
            (advantages + values).reshape(-1),
        )
        for rows in torch.randperm(STEPS * ROWS).chunk(4):
            now = Categorical(logits=actor(flat[rows]))
            ratio = (now.log_prob(actions.reshape(-1)[rows]) - logprobs.reshape(-1)[rows]).exp()
            own = (advantage[rows] - advantage[rows].mean()) / (advantage[rows].std() + 1e-8)
            policy_loss = -torch.min(own * ratio, own * ratio.clamp(1 - CLIP, 1 + CLIP)).mean()
            value_loss = 0.5 * (critic(flat[rows]).view(-1) - target[rows]).square().mean()
            loss = policy_loss - 0.01 * now.entropy().mean() + 0.5 * value_loss
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(weights, 0.5)
            optimiser.step()
            losses.append(loss.item())
    envs.close()
    return (
        losses,
        returns,
        max(float((now.detach() - then).abs().max()) for now, then in zip(weights, first)),
    )


@pytest.mark.parametrize("make_envs", [one_by_one, as_a_batch])
def test_its_ppo_trains_on_single_environments_and_on_the_batch(make_envs):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        losses, returns, moved = train(make_envs(), 2)
    assert np.isfinite(losses).all()
    assert moved > 1e-4
    # 100 m take some 8 decisions: the goal's 100, or a crash's or the verge's -100.
    assert len(returns) >= 10
    assert {round(value, -2) for value in returns} <= {-100.0, 0.0, 100.0}
