"""The logs of a run besides its CSV files, by the name of the option."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from ganlane.training.log import Log
from ganlane.training.tensorboard import TensorBoardLog
from ganlane.training.wandb import WandbLog


class LoggerOptions(Protocol):
    """What :func:`make_logs` reads of ``logger=...``: ``csv``, ``tensorboard`` or ``wandb``, and W&B's project."""

    kind: str
    project: str


def make_logs(options: LoggerOptions, folder: str | Path, about: Mapping[str, Any] | None = None) -> list[Log]:
    """The further logs of a run.

    Args:
        options: which.
        folder: of the run.
        about: JSON-serialisable settings of the run, for the logs that show them.

    Raises:
        UserError: the package that one of them needs is not installed.
    """
    if options.kind == "tensorboard":
        return [TensorBoardLog(Path(folder) / "tensorboard")]
    if options.kind == "wandb":
        return [WandbLog(folder, options.project, about)]
    return []
