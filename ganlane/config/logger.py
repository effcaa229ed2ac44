"""``logger=...``: where the figures of a training run go besides ``metrics.csv``."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.config.checks import check, one_of


@dataclass
class LoggerConfig:
    """``logger=csv``: nowhere else; ``logger=tensorboard``: event files in the run folder as well."""

    kind: str = "csv"
    progress: bool = True

    def __post_init__(self) -> None:
        check(self, "logger", kind=one_of(("csv", "tensorboard")))


@dataclass
class TensorBoardLoggerConfig(LoggerConfig):
    """``logger=tensorboard``."""

    kind: str = "tensorboard"
