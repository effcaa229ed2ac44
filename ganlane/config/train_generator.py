"""Root of ``ganlane train_generator``."""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.config.data import DataConfig
from ganlane.config.generator import GeneratorConfig
from ganlane.config.run import RunConfig


@dataclass
class TrainGeneratorConfig(RunConfig):
    """Recordings, and what is fitted to them."""

    data: DataConfig = field(default_factory=DataConfig)
    generator: GeneratorConfig = field(default_factory=GeneratorConfig)
