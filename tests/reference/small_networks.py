"""Small generators, and quick settings of fits."""

from __future__ import annotations

from dataclasses import replace

import torch

from ganlane.generator.networks import Generator
from ganlane.native.drivers import GeneratedDrivers
from ganlane.settings.driving import IdmParameters
from ganlane.settings.episode import Stream
from ganlane.settings.generated import ANCHOR, HEADWAY_QUANTILES_S
from ganlane.settings.generator import CalibratedConfig, GeneratorSizes, LoopConfig, PaperConfig

SIZES = GeneratorSizes(embedding=16, hidden=12, pooling=10, pooled=6, context=14, noise=4)
LOOP = LoopConfig(updates=4, evaluate_every=2, warmup=1)
PAPER = PaperConfig(SIZES, loop=LOOP, stride=6, samples=2, batch=4)
CALIBRATED = CalibratedConfig(
    replace(SIZES, extra_inputs=4),
    LOOP,
    (4,),
    (1.0,),
    held_out_horizon=8,
    batch=2,
    held_out_stride=20,
)


def small_generator(extra_inputs: int = 0, seed: int = 0) -> Generator:
    """A generator with random weights."""
    torch.manual_seed(seed)
    return Generator(replace(SIZES, extra_inputs=extra_inputs))


def anchored_drivers(
    generator: Generator, headways_s: tuple[float, ...] = HEADWAY_QUANTILES_S
) -> GeneratedDrivers:
    """Drivers of the calibrated traffic with the generator's sizes."""
    return GeneratedDrivers(
        IdmParameters(),
        generator.sizes,
        {},
        Stream.TRAIN,
        noise_scale=1.0,
        noise_period_s=5.0,
        anchor=ANCHOR,
        headways_s=headways_s,
    )


def silenced(generator: Generator) -> Generator:
    """The generator with a head of zeros: its residual is 0."""
    torch.nn.init.zeros_(generator.head.weight)
    torch.nn.init.zeros_(generator.head.bias)
    return generator
