"""``logger=...``: where the figures of a training run go besides ``metrics.csv``."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.parameters.checks import check, one_of, text


@dataclass
class LoggerConfig:
    """``logger=csv``: nowhere else; ``logger=tensorboard``: event files in the run folder; ``logger=wandb``: W&B.

    ``project`` is W&B's and means nothing to the others.
    """

    kind: str = "csv"
    progress: bool = True
    project: str = "ganlane"

    def __post_init__(self) -> None:
        check(self, "logger", kind=one_of(("csv", "tensorboard", "wandb")), project=text())


@dataclass
class TensorBoardLoggerConfig(LoggerConfig):
    """``logger=tensorboard``."""

    kind: str = "tensorboard"


@dataclass
class WandbLoggerConfig(LoggerConfig):
    """``logger=wandb``."""

    kind: str = "wandb"
