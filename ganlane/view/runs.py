"""Figures of training runs: ``metrics.csv`` and ``evaluation.csv`` of their folders as one table per run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl
from polars.exceptions import PolarsError

from ganlane.errors import UserError

#: Number of decisions so far: the horizontal axis of every learning curve.
X_COLUMN = "decisions"
#: Put before the names of the columns of ``evaluation.csv``.
EVALUATION = "evaluation_"


def read_metrics(path: str | Path) -> pl.DataFrame:
    """A run's metrics: the file itself, or ``metrics.csv`` in the run's folder.

    Raises:
        UserError: no such file, it cannot be read, or it has no column ``decisions`` or no rows.
    """
    path = Path(path)
    file = path / "metrics.csv" if path.is_dir() else path
    if not file.is_file():
        raise UserError(f"{file}: no such file; expected the metrics.csv of a training run, give its run folder.")
    try:
        frame = pl.read_csv(file, infer_schema_length=None)
    except (PolarsError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{file}: not a readable CSV file ({reason}); give a run's metrics.csv.") from error
    if X_COLUMN not in frame.columns or frame.height == 0:
        raise UserError(f"{file}: expected a column '{X_COLUMN}' and at least one row; give a run's metrics.csv.")
    return frame


def read_run(path: str | Path) -> pl.DataFrame:
    """``metrics.csv`` of a run's folder, merged with the rows of ``evaluation.csv`` if there is one.

    Returns:
        ``decisions`` and the columns of both files, those of the second with :data:`EVALUATION` before their names;
        null where a row is of the other file.

    Raises:
        UserError: see :func:`read_metrics`.
    """
    path = Path(path)
    metrics, evaluation = read_metrics(path), path / "evaluation.csv"
    if not path.is_dir() or not evaluation.is_file():
        return metrics
    evaluated = read_metrics(evaluation)
    renamed = {name: EVALUATION + name for name in evaluated.columns if name != X_COLUMN}
    return pl.concat([metrics, evaluated.rename(renamed)], how="diagonal_relaxed").sort(X_COLUMN)


def run_names(paths: Sequence[str | Path]) -> list[str]:
    """The shortest ends of the runs' folders that tell them apart.

    Raises:
        UserError: a folder comes twice.
    """
    folders = [path if path.is_dir() else path.parent for path in (Path(each).resolve() for each in paths)]
    for depth in range(1, max(len(folder.parts) for folder in folders) + 1):
        names = ["/".join(folder.parts[-depth:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    raise UserError(f"run={','.join(map(str, paths))}: a folder comes twice; give each run once.")


def read_runs(paths: Sequence[str | Path]) -> dict[str, pl.DataFrame]:
    """Name (:func:`run_names`) and metrics (:func:`read_run`) of every run folder.

    Raises:
        UserError: see these two.
    """
    return {name: read_run(path) for name, path in zip(run_names(paths), paths)}


def running_mean(values: npt.NDArray[np.float64], window: int) -> npt.NDArray[np.float64]:
    """Mean over the last ``window`` values, without those that are NaN; NaN where the value itself is.

    At the start it takes in the values that there are.
    """
    known = np.isfinite(values)
    total = np.cumsum(np.where(known, values, 0.0))
    count = np.cumsum(known)
    total[window:], count[window:] = total[window:] - total[:-window], count[window:] - count[:-window]
    return np.where(known, total / np.maximum(count, 1), np.nan)
