"""Training runs beside each other: what they earned, how they drove, and whether their Q-values were right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl
from PIL import Image

from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.view.curves import X_COLUMN, curve_panel, curve_sheet, draw_curves, lines_of, read_metrics

#: What the columns of ``evaluation.csv`` are called beside those of ``metrics.csv``.
EVALUATION = "evaluation_"


@dataclass(frozen=True)
class Drawn:
    """One panel: a column, and another one that is drawn dashed in the same colours."""

    title: str
    column: str
    dashed: str = ""


PANELS = (
    Drawn("mean return", "mean_return"),
    Drawn("crash rate", "crash_rate"),
    Drawn("lane changes per km", "lane_changes_per_km"),
    Drawn("mean Q (replayed); dashed: discounted return", "mean_q", "mean_discounted_return"),
    Drawn("evaluation: mean return", f"{EVALUATION}mean_reward"),
    Drawn("evaluation: crash rate", f"{EVALUATION}crash_rate"),
    Drawn("evaluation: lane changes per km", f"{EVALUATION}lane_changes_per_km"),
)


def read_run(path: str | Path) -> pl.DataFrame:
    """``metrics.csv`` of a run's folder, and below it the rows of ``evaluation.csv`` if there is one.

    Returns:
        ``decisions`` and the columns of both files, those of the second with :data:`EVALUATION` before their names;
        null where a row is of the other file.

    Raises:
        UserError: see :func:`ganlane.view.read_metrics`.
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


def draw_runs(runs: Mapping[str, pl.DataFrame], columns: Sequence[str] | None = None, smooth: int = 1) -> Image.Image:
    """The :data:`PANELS` that any of the runs has numbers for, one colour per run.

    Args:
        runs: name to figures (:func:`read_run`).
        columns: these columns instead of the panels.
        smooth: rows that the running mean takes in; 1 for none.

    Raises:
        UserError: there is nothing to draw, or a column that no run has.
    """
    if columns is not None:
        return draw_curves(runs, columns, smooth)
    drawn = [each for each in PANELS if any(_has_numbers(frame, each.column) for frame in runs.values())]
    if not drawn:
        known = ", ".join(each.column for each in PANELS)
        raise UserError(f"run={','.join(runs)}: no numbers in any of {known}; give the folder of a training run.")
    panels = []
    for each in drawn:
        dashed = lines_of(runs, each.dashed, smooth, dashed=True) if each.dashed else []
        panels.append(curve_panel(each.title, [*lines_of(runs, each.column, smooth), *dashed]))
    return curve_sheet(panels, list(runs))


def write_runs(
    paths: Sequence[str | Path], out: str | Path, columns: Sequence[str] | None = None, smooth: int = 1
) -> Path:
    """Draw the runs in the folders ``paths`` as a PNG file, atomically, and return its path.

    Raises:
        UserError: see :func:`read_run`, :func:`run_names` and :func:`draw_runs`.
    """
    runs = {name: read_run(path) for name, path in zip(run_names(paths), paths)}
    sheet = draw_runs(runs, columns, smooth)
    with atomic_path(out) as part:
        sheet.save(part, format="PNG", optimize=True)
    return Path(out)


def _has_numbers(frame: pl.DataFrame, column: str) -> bool:
    known = column in frame.columns and frame.schema[column].is_numeric()
    return known and bool(frame[column].is_not_null().any())
