"""Learning curves of training runs: the metrics of their folders, over the number of decisions."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
#: Prefix of the columns of ``evaluation.csv``.
EVALUATION = "evaluation_"
#: Matplotlib cannot scale an axis for much larger numbers.
_LARGEST = 1e100


@dataclass(frozen=True)
class Panel:
    """One panel: a column, its axis label, and a second column drawn dashed."""

    title: str
    column: str
    label: str = ""
    dashed: str = ""


PANELS = [
    # Reward per episode, undiscounted; the agent itself maximises the discounted return.
    Panel("mean return", "mean_return", "reward per episode"),
    Panel("crash rate", "crash_rate", "share of episodes"),
    Panel("lane changes", "lane_changes_per_km", "per km"),
    Panel(
        "mean Q (replayed); dashed: discounted return",
        "mean_q",
        "reward",
        "mean_discounted_return",
    ),
    Panel("evaluation: mean return", f"{EVALUATION}mean_reward", "reward per episode"),
    Panel("evaluation: crash rate", f"{EVALUATION}crash_rate", "share of episodes"),
    Panel("evaluation: lane changes", f"{EVALUATION}lane_changes_per_km", "per km"),
]


def read_metrics(path: str | Path) -> pl.DataFrame:
    """A run's metrics: the file itself, or ``metrics.csv`` in the run's folder.

    Raises:
        UserError: no such file, it cannot be read, it holds text, or it has no column ``decisions``
            or no rows.
    """
    path = Path(path)
    file = path / "metrics.csv" if path.is_dir() else path
    if not file.is_file():
        raise UserError(
            f"{file}: no such file; expected the metrics.csv of a training run, give its run "
            "folder."
        )
    try:
        # Types are inferred from all rows: a column may be empty for the first thousands.
        frame = pl.read_csv(file, infer_schema_length=None)
    except (PolarsError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"{file}: not a readable CSV file ({reason}); give a run's metrics.csv."
        ) from error
    # The two files of a run have this column in common; without it nothing can be drawn.
    if X_COLUMN not in frame.columns or frame.is_empty():
        raise UserError(
            f"{file}: expected a column '{X_COLUMN}' and at least one row; give a run's "
            "metrics.csv."
        )
    # Text, or numbers beyond what can be drawn, is refused by its column. NaN is a gap.
    for column in frame.iter_columns():
        wrong = column.drop_nulls()
        if column.dtype.is_numeric():
            wrong = wrong.filter(wrong.is_finite() & (wrong.abs() > _LARGEST))
        if wrong.len():
            raise UserError(
                f"{file}: column {column.name!r} holds {str(wrong[0])[:40]!r}, expected numbers "
                "that one can draw; repair it."
            )
    return frame


def read_run(path: str | Path) -> pl.DataFrame:
    """``metrics.csv`` of a run's folder, with the rows of ``evaluation.csv`` if there is one.

    Returns:
        ``decisions`` and the columns of both files, those of the second with :data:`EVALUATION`
        before their names; null where a row is of the other file.

    Raises:
        UserError: see :func:`read_metrics`.
    """
    path = Path(path)
    metrics, evaluation = read_metrics(path), path / "evaluation.csv"
    if not evaluation.is_file():
        return metrics
    evaluated = read_metrics(evaluation).select(
        X_COLUMN, pl.exclude(X_COLUMN).name.prefix(EVALUATION)
    )
    # Rows of both files, in order of decisions; columns of the other file are null there.
    return pl.concat([metrics, evaluated], how="diagonal_relaxed").sort(X_COLUMN)


def read_runs(paths: Sequence[str | Path]) -> dict[str, list[pl.DataFrame]]:
    """Metrics (:func:`read_run`) of run folders, and of all runs in the folder of a sweep, by name.

    Names are those of :func:`ganlane.evaluation.results.names_of_runs`. Runs that differ in their
    seeds alone share one, without the seed.

    Raises:
        UserError: a folder comes twice, or cannot be read.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        # A folder without runs is refused when it is read.
        files += (path.is_dir() and runs_below(path.resolve(), "metrics.csv")) or [path.resolve()]
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
def draw_runs(
    runs: Mapping[str, Sequence[pl.DataFrame]],
    columns: Sequence[str] | None = None,
    smooth: int = 1,
) -> Figure:
    """Training runs over the number of decisions, one colour per name.

    Args:
        runs: name to metrics (:func:`read_run`): one, or the same with several seeds. Of several,
            the mean is drawn, in a band from the lowest to the highest.
        columns: one panel for each of these; by default those of :data:`PANELS` that any run has
            numbers for.
        smooth: rows that the running mean takes in; above 1 the rows themselves are drawn faintly.

    Raises:
        UserError: there is nothing to draw, or a column that no run has.
    """
    with_numbers: dict[str, None] = {}  # in the order of the files
    for frame in (frame for frames in runs.values() for frame in frames):
        numeric = [column for column in frame if column.dtype.is_numeric()]
        with_numbers |= {column.name: None for column in numeric if column.count()}
    with_numbers.pop(X_COLUMN, None)
    for name in columns or ():
        if name not in with_numbers:
            raise UserError(
                f"column {name}: no run has numbers there; choose among {', '.join(with_numbers)}."
            )
    panels = PANELS
    if columns is not None:
        # Columns the caller names are drawn under their own names.
        panels = [Panel(name.replace("_", " "), name, name.replace("_", " ")) for name in columns]
    drawn = [panel for panel in panels if panel.column in with_numbers]
    if not drawn:
        wanted = ", ".join(panel.column for panel in PANELS)
        raise UserError(
            f"run={','.join(runs)}: no numbers in any of {wanted}; give the folder of a training "
            "run."
        )
    figure, grid = panel_grid(len(drawn))
    colours = palette(list(runs))
    for axes, panel in zip(grid, drawn):
        axes.set(title=panel.title, ylabel=panel.label, xlabel=X_COLUMN)
        axes.xaxis.set_major_formatter(EngFormatter())
        for name, frames in runs.items():
            style: dict[str, Any] = {"color": colours[name]}
            # Smoothing hides the spread, so a single run is also drawn unsmoothed, faintly.
            if smooth > 1 and len(frames) == 1:
                plot_middle(axes, _lines(frames, panel.column), **style, alpha=0.3, lw=0.8)
            lines = _lines(frames, panel.column, smooth)
            plot_middle(axes, lines, with_range=True, **style)
            plot_middle(axes, _lines(frames, panel.dashed, smooth), **style, ls="--", lw=1.2)
    legend = {}
    for name, frames in runs.items():
        count = f" ({len(frames)} seeds: mean, range)" if len(frames) > 1 else ""
        legend[name + count] = colours[name]
    add_legend(figure, legend)
    return figure


def _lines(
    frames: Sequence[pl.DataFrame], column: str, smooth: int = 1
) -> list[tuple[FloatArray, FloatArray]]:
    """Decisions and values of a column, of every run that has it: the means over ``smooth`` rows.

    Means ignore NaN, and are NaN where the value itself is.
    """
    lines = []
    # NaN counts as missing; gaps stay gaps, instead of being filled by the rolling mean.
    number = pl.col(column).fill_nan(None)
    mean = pl.when(number.is_not_null()).then(number.rolling_mean(smooth, min_samples=1))
    for frame in frames:
        if column in frame.columns:
            table = frame.select(pl.col(X_COLUMN, column).cast(pl.Float64)).drop_nulls()
            if smooth > 1:
                table = table.with_columns(mean.alias(column))
            if table.height:
                lines.append((table[X_COLUMN].to_numpy(), table[column].to_numpy()))
    return lines


def plot_middle(
    axes: Axes,
    lines: Sequence[tuple[FloatArray, FloatArray]],
    with_range: bool = False,
    middle: Callable[..., FloatArray] = np.mean,
    **style: Any,
) -> None:
    """One line as it is; of several, the ``middle`` and perhaps the range where all have values."""
    if len(lines) == 1:
        plot_line(axes, *lines[0], **style)
    if len(lines) < 2:
        return
    # Seeds are logged at different decisions: values in between are interpolated.
    x = np.unique(np.concatenate([x for x, _ in lines]))
    # Only where all have values, else the middle would jump where a run begins or ends.
    first, last = max(x[0] for x, _ in lines), min(x[-1] for x, _ in lines)
    shared = x[(x >= first) & (x <= last)]
    values = np.stack([np.interp(shared, *line) for line in lines])
    plot_line(axes, shared, middle(values, axis=0), **style)
    if with_range:
        low, high = values.min(0), values.max(0)
        axes.fill_between(shared, low, high, **style, alpha=0.18, lw=0)
