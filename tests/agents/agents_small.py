"""A small agent, its file, and transitions as its replay buffer takes them."""

from pathlib import Path

import torch
from tensordict import TensorDict

from ganlane.agents import Rainbow, RainbowConfig, save_agent

SMALL = {"hidden": (8, 8), "batch_size": 32, "warmup": 32, "capacity": 500}


def agent(size=5, seed=0, legal=None, **options):
    return Rainbow(RainbowConfig(**{**SMALL, **options}), size, seed=seed, legal=legal)


def saved_in(folder: Path, **more) -> Path:
    path = folder / "agent.safetensors"
    save_agent(path, agent(), {"observation": "table3", "training": {"decisions": 7}, **more})
    return path


def transitions(size, rows=64, scale=1.0, most_steps=1):
    """``rows`` transitions with observations of ``size`` numbers; one of five or so is terminal.

    Rewards have a standard deviation of ``scale``; a transition is of 1 to ``most_steps`` steps.
    """
    generator = torch.Generator().manual_seed(0)

    def normal(columns):
        return torch.randn(rows, columns, generator=generator)

    after = {
        "observation": normal(size),
        "reward": scale * normal(1),
        "terminated": torch.rand(rows, 1, generator=generator) < 0.2,
        # which no loss may read: a truncated episode goes on
        "done": torch.rand(rows, 1, generator=generator) < 0.5,
    }
    steps = torch.randint(1, most_steps + 1, (rows, 1), generator=generator)
    content = {
        "observation": normal(size),
        "action": torch.randint(0, 3, (rows,), generator=generator),
        "steps_to_next_obs": steps.float(),
        "next": after,
    }
    return TensorDict(content, [rows])


def same_weights(first, second):
    """Whether two agents have the same weights, bit for bit."""
    pairs = zip(first.weights().values(), second.weights().values(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)
