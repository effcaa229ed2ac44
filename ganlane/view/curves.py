"""Learning curves of training runs: the metrics of their folders, over the number of decisions."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from polars.exceptions import PolarsError

from ganlane.errors import UserError
from ganlane.evaluation.results import names_of_runs, runs_below
from ganlane.view.figures import STYLE, FloatArray, add_legend, palette, panel_grid, plot_line

#: Number of decisions so far: the horizontal axis of every learning curve.
X_COLUMN = "decisions"
#: Title and unit of the columns that are drawn, in the order of the panels. The agent maximises the
#: discounted return, of which mean Q is its own estimate.
PANELS = {
    "mean_return": ("mean return", "reward per episode"),
    "crash_rate": ("crash rate", "share of episodes"),
    "lane_changes_per_km": ("lane changes", "per km"),
    "mean_q": ("mean Q (replayed)", "reward"),
    "mean_discounted_return": ("discounted return", "reward"),
    "evaluation_mean_reward": ("evaluation: mean return", "reward per episode"),
    "evaluation_crash_rate": ("evaluation: crash rate", "share of episodes"),
    "evaluation_lane_changes_per_km": ("evaluation: lane changes", "per km"),
}


def read_metrics(path: str | Path) -> pl.DataFrame:
    """A run's metrics: the file itself, or ``metrics.csv`` in the run's folder.

    Raises:
        UserError: no such file, it cannot be read, it holds text, or it has no column ``decisions``
            or no rows.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "metrics.csv"
    try:
        # Types are inferred from all rows: a column may be empty for the first thousands.
        frame = pl.read_csv(file, infer_schema_length=None)
        numbers = frame.select(X_COLUMN, pl.exclude(X_COLUMN)).cast(pl.Float64)
        if numbers.is_empty():
            raise ValueError("it has no rows")
    except (PolarsError, OSError, ValueError) as error:
        # The messages of polars have several lines.
        reason = str(error).splitlines()[0]
        raise UserError(
            f"{file}: no metrics of a training run ({reason:.200}); give a run's folder or its "
            "metrics.csv."
        ) from error
    return numbers


def read_run(path: str | Path) -> pl.DataFrame:
    """``metrics.csv`` of a run's folder, with the rows of ``evaluation.csv`` if there is one.

    Returns:
        ``decisions`` and the columns of both files, those of the second with ``evaluation_`` before
        their names; null where a row is of the other file.

    Raises:
        UserError: see :func:`read_metrics`.
    """
    path = Path(path)
    metrics = read_metrics(path)
    evaluation = path / "evaluation.csv"
    if not evaluation.is_file():
        return metrics
    columns = pl.exclude(X_COLUMN).name.prefix("evaluation_")
    evaluated = read_metrics(evaluation).select(X_COLUMN, columns)
    # Rows of both files, in order of decisions; columns of the other file are null there.
    return pl.concat([metrics, evaluated], how="diagonal_relaxed").sort(X_COLUMN)


def read_runs(paths: Sequence[str | Path]) -> dict[str, list[pl.DataFrame]]:
    """Metrics (:func:`read_run`) of run folders, and of all runs in the folder of a sweep, by name.

    Names are those of :func:`ganlane.evaluation.results.names_of_runs`. Runs that differ in their
    seeds alone share one, without the seed.

    Raises:
        UserError: a folder comes twice, or cannot be read.
    """
    # Files of metrics, or folders that hold one.
    files: list[Path] = []
    for path in paths:
        place = Path(path).resolve()
        # A folder without runs is refused when it is read.
        files += runs_below(place, "metrics.csv") or [place]
    # Twice the same run would be drawn as two seeds that agree perfectly.
    if len(set(files)) < len(files):
        raise UserError(
            f"run={','.join(map(str, paths))}: a folder comes twice; give each run once."
        )

    folders = [file.parent if file.suffix == ".csv" else file for file in files]
    runs: dict[str, list[pl.DataFrame]] = {}
    for name, file in zip(names_of_runs(folders), files):
        # Runs that differ only in their seed share a name, and so become one line.
        without_seed = re.sub(r"(^|, )seed=[^,]*$", "", name) or "all seeds"
        runs.setdefault(without_seed, []).append(read_run(file))
    return runs


@rc_context(STYLE)
def draw_runs(runs: Mapping[str, Sequence[pl.DataFrame]]) -> Figure:
    """Training runs over the number of decisions, one colour per name.

    Args:
        runs: by name the metrics (:func:`read_run`) of one run, or of the same with several seeds,
            whose mean is drawn in a band from the lowest to the highest.

    Returns:
        A figure with a panel for those of :data:`PANELS` that any run has numbers for.

    Raises:
        UserError: there is nothing to draw.
    """
    # By column, of every name.
    lines = {}
    for column in PANELS:
        of_column = {name: _lines(frames, column) for name, frames in runs.items()}
        # Without numbers there is no panel.
        if any(of_column.values()):
            lines[column] = of_column
    if not lines:
        raise UserError(
            f"run={','.join(runs)}: no numbers in any of {', '.join(PANELS)}; give the folder of a "
            "training run."
        )

    figure, grid = panel_grid(len(lines))
    colours = palette(list(runs))
    for axes, (column, of_column) in zip(grid, lines.items()):
        title, unit = PANELS[column]
        axes.set(title=title, ylabel=unit, xlabel=X_COLUMN)
        # 100 k rather than 100000.
        axes.xaxis.set_major_formatter(EngFormatter())
        for name, of_run in of_column.items():
            plot_middle(axes, of_run, color=colours[name])

    legend = {}
    for name, frames in runs.items():
        count = f" ({len(frames)} seeds: mean, range)" if len(frames) > 1 else ""
        legend[name + count] = colours[name]
    add_legend(figure, legend)
    return figure


def _lines(frames: Sequence[pl.DataFrame], column: str) -> list[tuple[FloatArray, FloatArray]]:
    """Decisions and values of a column, of every run that has it."""
    lines = []
    for frame in frames:
        if column not in frame.columns:
            continue
        # Null where the run has not logged it.
        table = frame.select(X_COLUMN, column).drop_nulls()
        if table.height:
            lines.append((table[X_COLUMN].to_numpy(), table[column].to_numpy()))
    return lines


def plot_middle(
    axes: Axes,
    lines: Sequence[tuple[FloatArray, FloatArray]],
    middle: Callable[..., FloatArray] = np.mean,
    **style: Any,
) -> None:
    """Draw the curve of one run as it is; of several, their middle and their range.

    Args:
        axes: the panel.
        lines: places and values, [T] each, of every run; there may be none.
        middle: of the runs' values, mean or median.
        **style: of the line, as for matplotlib.
    """
    if len(lines) == 1:
        plot_line(axes, *lines[0], **style)
    if len(lines) < 2:
        return

    # Seeds are logged at different decisions: values in between are interpolated.
    x = np.unique(np.concatenate([x for x, _ in lines]))
    # Only where all have values, else the middle would jump where a run begins or ends.
    first = max(x[0] for x, _ in lines)
    last = min(x[-1] for x, _ in lines)
    shared = x[(x >= first) & (x <= last)]
    values = np.stack([np.interp(shared, *line) for line in lines])
    plot_line(axes, shared, middle(values, axis=0), **style)
    axes.fill_between(shared, values.min(0), values.max(0), **style, alpha=0.18, lw=0)
