"""Small generators for tests."""

from __future__ import annotations

import torch

from ganlane.generator.networks import Generator
from ganlane.parameters.generator import GeneratorSizes

SIZES = GeneratorSizes(embedding=16, hidden=12, pooling=10, pooled=6, context=14, noise=4)


def small_generator(extra_inputs: int = 0, seed: int = 0) -> Generator:
    """A generator with random weights."""
    torch.manual_seed(seed)
    return Generator(GeneratorSizes(**{**vars(SIZES), "extra_inputs": extra_inputs}))


def silenced(generator: Generator) -> Generator:
    """The generator with a head of zeros: its residual is 0."""
    torch.nn.init.zeros_(generator.head.weight)
    torch.nn.init.zeros_(generator.head.bias)
    return generator
