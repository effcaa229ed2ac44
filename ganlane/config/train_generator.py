"""Root of ``ganlane train_generator``."""

from __future__ import annotations

from dataclasses import dataclass, field

from ganlane.config.data import DataConfig
from ganlane.config.generator import GeneratorConfig
from ganlane.config.run import RunConfig
from ganlane.errors import UserError


@dataclass
class TrainGeneratorConfig(RunConfig):
    """Recordings, and what is fitted to them."""

    data: DataConfig = field(default_factory=DataConfig)
    generator: GeneratorConfig = field(default_factory=GeneratorConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.device != "cpu":
            raise UserError(f"device={self.device}: generators are fitted on the CPU, in minutes; use device=cpu.")
