"""DQN in one file, in CleanRL's style, on gymnasium's vector interface: 64 highways stepped as one
batch.

Run it with ``python examples/cleanrl_style.py``; a few seconds of training by default, more with
``python examples/cleanrl_style.py 500000``.
"""

from __future__ import annotations

import sys

import gymnasium
import numpy as np
import torch
from torch import nn

import ganlane  # noqa: F401 - registers the environments

BATCH = 256
CAPACITY = 50_000
GAMMA = 0.98
TARGET_EVERY = 100


def next_observations(observation, ended, info):
    """Observations after the decision.

    Where an episode ended its last one, not the first of the next episode.
    """
    following = observation.copy()
    if ended.any():
        following[ended] = np.stack(info["final_obs"][ended])
    return following


def update(network, target, optimiser, batch):
    """One gradient step on the temporal difference (Huber loss); time-outs are bootstrapped."""
    observation, action, reward, following, terminated = batch
    with torch.no_grad():
        expected = reward + GAMMA * target(following).amax(1) * ~terminated
    value = network(observation).gather(1, action[:, None])[:, 0]
    loss = nn.functional.smooth_l1_loss(value, expected)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    return loss.item()


def main(decisions=16_384, num_envs=64):
    """Collect, store, update."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    envs = gymnasium.make_vec(
        "ganlane/Highway-v0", num_envs=num_envs, traffic="idm_mobil", goal_m=1000.0
    )
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    size = envs.single_observation_space.shape[0]
    actions = envs.single_action_space.n
    network, target = (
        nn.Sequential(
            nn.Linear(size, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, actions)
        )
        for _ in range(2)
    )
    target.load_state_dict(network.state_dict())
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-4)
    shapes = {
        "observation": (size,),
        "action": (),
        "reward": (),
        "following": (size,),
        "terminated": (),
    }
    kinds = {"action": torch.int64, "terminated": torch.bool}
    memory = {
        name: torch.zeros(CAPACITY, *shape, dtype=kinds.get(name)) for name, shape in shapes.items()
    }
    observation, info = envs.reset(seed=0)
    loss = float("nan")
    for step in range(decisions // num_envs):
        epsilon = max(0.05, 1.0 - 2.0 * step * num_envs / decisions)
        with torch.no_grad():
            action = network(torch.from_numpy(observation)).argmax(1).numpy()
        # Random actions are drawn among those that stay on the road.
        legal = info["action_mask"] * rng.random((num_envs, actions))
        action = np.where(rng.random(num_envs) < epsilon, legal.argmax(1), action)
        before = observation
        observation, reward, terminated, truncated, info = envs.step(action)
        following = next_observations(observation, terminated | truncated, info)
        rows = torch.arange(step * num_envs, (step + 1) * num_envs) % CAPACITY
        for name, value in zip(memory, (before, action, reward, following, terminated)):
            memory[name][rows] = torch.as_tensor(value, dtype=memory[name].dtype)
        filled = min((step + 1) * num_envs, CAPACITY)
        if filled >= 4 * BATCH:
            drawn = torch.from_numpy(rng.integers(filled, size=BATCH))
            loss = update(network, target, optimiser, [field[drawn] for field in memory.values()])
        if step % TARGET_EVERY == 0:
            target.load_state_dict(network.state_dict())
    returns = list(envs.return_queue)
    print(f"{decisions} decisions, {envs.episode_count} episodes, loss {loss:.3f}")
    mean = np.mean(returns) if returns else float("nan")
    print(f"mean return of the last {len(returns)}: {mean:.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
