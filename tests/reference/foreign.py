"""What the tests of foreign simulators share: episodes with given commands, and every physics step of them."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from ganlane import keys
from ganlane.sim.state import Vehicles


def start(env, episodes, seed=0):
    """The start of certain episodes."""
    episode = torch.tensor(episodes)
    return env.reset(TensorDict({keys.SEED: torch.full_like(episode, seed), keys.EPISODE: episode}, [len(episodes)]))


def drive(env, episodes, decisions, command=lambda decision, episode: 0):
    """The vehicles [T + 1, N, M] after each physics step, which rows ran in it [T, N], and the last state."""
    state, steps, running = start(env, episodes), [], []
    steps.append(Vehicles.of(state[keys.VEHICLES]))
    done = state["done"][:, 0]

    def record(vehicles, rows):
        steps.append(vehicles)
        running.append(rows & ~done)

    env.recorder = record
    for decision in range(decisions):
        state[keys.ACTION] = torch.tensor([command(decision, episode) for episode in episodes])
        done = state["done"][:, 0]
        state = env.step(state)["next"].clone()
        state["done"] |= done[:, None]
        if state["done"].all():
            break
    env.recorder = None
    return Vehicles(*(torch.stack(fields) for fields in zip(*steps))), torch.stack(running), state


def turns(decision, episode):
    """Now and then a change of lanes, in no order."""
    return (decision * 7 + episode) % 3 if decision % 4 == 0 else 0
