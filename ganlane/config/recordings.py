"""Roots of ``ganlane prepare`` and ``ganlane train_generator``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ganlane.config.run import RunConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import at_least, check, optional
from ganlane.parameters.data import DataConfig
from ganlane.parameters.generator import FitConfig


@dataclass
class PrepareConfig(RunConfig):
    """Recordings, and where their Parquet goes. Nothing is drawn at random; polars takes its own number of threads.

    Attributes:
        seed: of no effect.
        threads: of no effect (POLARS_MAX_THREADS).
        out: folder to make for the Parquet files; null: 'scenes' in the run folder.
        scene_s: cut recordings into scenes of so many seconds, so that some can be held out.
    """

    data: DataConfig = field(default_factory=DataConfig)
    out: str | None = None
    scene_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, scene_s=optional(at_least(1)))
        if self.device != "cpu":
            raise UserError(f"device={self.device}: recordings are prepared on the CPU; use device=cpu.")
        if self.data.format != "scenes" and self.data.path is None:
            raise UserError(f"data={self.data.format}: which file is missing; give data.path=FILE.")


@dataclass
class TrainGeneratorConfig(RunConfig):
    """Recordings, what is fitted to them, and how it is measured.

    Attributes:
        folds: fit this many more, each without the scenes of its fold, and pool their errors; 0: none.
        ablations: true: fit the preset with one part changed at a time, each with a quarter of the updates.
        resume: folder of an earlier run: what was fitted there is not fitted again.
    """

    data: DataConfig = field(default_factory=DataConfig)
    generator: FitConfig = field(default_factory=FitConfig)
    folds: int = 0
    ablations: bool = False
    resume: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, folds=at_least(0))
        if self.folds == 1:
            raise UserError("folds=1: one fold leaves nothing to fit to; use 2 or more, or 0 for none.")
        if self.resume is not None and not Path(self.resume).is_dir():
            raise UserError(f"resume={self.resume}: no such folder; give the folder of an earlier run.")
        if self.device != "cpu":
            raise UserError(f"device={self.device}: generators are fitted on the CPU, in minutes; use device=cpu.")
