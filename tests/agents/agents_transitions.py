"""Transitions made up for the tests of the agent, as its replay buffer takes them."""

from __future__ import annotations

import torch
from tensordict import TensorDict


def transitions(size, rows=64, seed=0):
    """``rows`` single steps with observations of ``size`` numbers; every fifth or so is terminal."""
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
