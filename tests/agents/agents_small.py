"""A small agent, its file, and transitions as its replay buffer takes them."""

from pathlib import Path

import torch
from tensordict import TensorDict

from ganlane.agents import Rainbow, RainbowConfig, save_agent

SMALL = {
    "hidden": (8, 8),
    "batch_size": 8,
    "warmup": 8,
    "capacity": 100,
}


def agent(size=5, seed=0, **options):
    return Rainbow(RainbowConfig(**{**SMALL, **options}), size, seed=seed)


def saved_in(folder: Path, **more) -> Path:
    path = folder / "agent.safetensors"
    save_agent(
        path,
        agent(),
        {
            "observation": "table3",
            "training": {"decisions": 7},
            **more,
        },
    )
    return path


def transitions(size, rows=64, seed=0):
    """``rows`` single steps, observations of ``size`` numbers; every fifth or so is terminal."""
    generator = torch.Generator().manual_seed(seed)
    after = {
        "observation": torch.randn(rows, size, generator=generator),
        "reward": torch.randn(rows, 1, generator=generator),
        "terminated": torch.rand(rows, 1, generator=generator) < 0.2,
    }
    content = {
        "observation": torch.randn(rows, size, generator=generator),
        "action": torch.randint(0, 3, (rows,), generator=generator),
        "steps_to_next_obs": torch.ones(rows, 1),
        "next": after,
    }
    return TensorDict(content, [rows])


def same_weights(first, second):
    return all(
        torch.equal(a, b) for a, b in zip(first.weights().values(), second.weights().values())
    )
