"""Root of ``ganlane train_generator``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ganlane.config.data import DataConfig
from ganlane.config.generator import GeneratorConfig
from ganlane.config.run import RunConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import at_least, check


@dataclass
class TrainGeneratorConfig(RunConfig):
    """Recordings, what is fitted to them, and how it is measured: pooled over ``folds`` (0: none), part by part."""

    data: DataConfig = field(default_factory=DataConfig)
    generator: GeneratorConfig = field(default_factory=GeneratorConfig)
    folds: int = 0
    ablations: bool = False
    resume: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "", folds=at_least(0))
        if self.folds == 1:
            raise UserError("folds=1: one fold leaves nothing to fit to; use 2 or more, or 0 for none.")
        if self.resume is not None and not Path(self.resume).is_dir():
            raise UserError(f"resume={self.resume}: no such folder; give the folder of an earlier run.")
        if self.device != "cpu":
            raise UserError(f"device={self.device}: generators are fitted on the CPU, in minutes; use device=cpu.")
