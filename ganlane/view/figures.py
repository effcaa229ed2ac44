"""Charts by matplotlib: the common style, learning curves of training runs, and statistics of
recordings.

Every ``draw`` function returns a ``Figure``; :func:`save_figure` writes it as PNG, SVG or PDF.
Figures are made without pyplot: they need no display, and no global list keeps them.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter
from PIL import Image
from polars.exceptions import PolarsError

from ganlane.data import Histogram, PooledStatistics, survival_curve
from ganlane.errors import UserError
from ganlane.evaluation.results import names_of_runs, runs_below
from ganlane.files import atomic_path

# It reports every table of a font that a PDF leaves out.
logging.getLogger("fontTools").setLevel(logging.WARNING)

FloatArray = npt.NDArray[np.float64]
#: Metrics of one run, or of the same with several seeds.
Runs: TypeAlias = "pl.DataFrame | Sequence[pl.DataFrame]"
#: Number of decisions so far: the horizontal axis of every learning curve.
X_COLUMN = "decisions"
#: Prefix of the columns of ``evaluation.csv``.
EVALUATION = "evaluation_"

INK, FAINT, GRID = "#262a30", "#6e747c", "#e2e5e9"
#: Okabe and Ito's palette, which colour-blind readers tell apart, with grey for its yellow (too
#: pale on white).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f")
#: Matplotlib's rc parameters for all figures (their type differs between its versions).
STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": FAINT,
    "axes.grid": True,
    "axes.labelcolor": FAINT,
    "axes.labelsize": 8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.constrained_layout.h_pad": 0.07,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.11,
    "font.size": 9,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 4,
    "pdf.fonttype": 42,  # TrueType, so that text in a PDF can be searched and edited
    "savefig.dpi": 120,
    "svg.hashsalt": "ganlane",  # the same figure gives the same file
    "text.color": INK,
    "xtick.color": FAINT,
    "xtick.labelsize": 8,
    "ytick.color": FAINT,
    "ytick.labelsize": 8,
}
#: File formats, and the metadata that would make two files of the same figure differ.
FORMATS: dict[str, dict[str, None]] = {
    "png": {},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}


@dataclass(frozen=True)
class Panel:
    """One panel of the learning curves: a column, its axis label, and a second column drawn dashed."""

    title: str
    column: str
    label: str = ""
    dashed: str = ""


PANELS = (
    Panel("mean return", "mean_return", "reward per episode"),
    Panel("crash rate", "crash_rate", "share of episodes"),
    Panel("lane changes", "lane_changes_per_km", "per km"),
    Panel(
        "mean Q (replayed); dashed: discounted return", "mean_q", "reward", "mean_discounted_return"
    ),
    Panel("evaluation: mean return", f"{EVALUATION}mean_reward", "reward per episode"),
    Panel("evaluation: crash rate", f"{EVALUATION}crash_rate", "share of episodes"),
    Panel("evaluation: lane changes", f"{EVALUATION}lane_changes_per_km", "per km"),
)


def palette(names: Sequence[str]) -> dict[str, str]:
    """A colour for each name; after seven they repeat."""
    return {name: COLOURS[index % len(COLOURS)] for index, name in enumerate(names)}


def save_figure(figure: Figure, path: str | Path, kind: str | None = None) -> Path:
    """Write a figure, atomically, as ``kind`` (one of :data:`FORMATS`; by default the file's
    ending).

    Raises:
        UserError: another format.
    """
    kind = kind or Path(path).suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise UserError(
            f"{path}: a figure is one of {', '.join(FORMATS)}; give the file one of these endings."
        )
    with atomic_path(path) as part, rc_context(STYLE):
        figure.savefig(part, format=kind, metadata=FORMATS[kind])
        if kind == "png":
            # 256 colours, which no chart exceeds by much, take a third of the size.
            with Image.open(part) as full:
                reduced = full.convert("RGB").quantize(256, dither=Image.Dither.NONE)
            reduced.save(part, format="png", optimize=True)
    return Path(path)


def panel_grid(
    count: int, width_in: float = 4.0, height_in: float = 2.3
) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` panels of this size, inches, about three in a row, and room for a
    legend above.
    """
    # As many rows as need be, none with a single panel below fuller ones.
    across = next(
        (number for number in (3, 2, 4, 5) if count > number and count % number != 1), min(3, count)
    )
    down = -(-count // across)
    figure = Figure(figsize=(across * width_in, down * height_in + 0.3))
    grid = figure.subplots(down, across, squeeze=False).ravel()
    for unused in grid[count:]:
        unused.remove()
    return figure, list(grid[:count])


def add_legend(figure: Figure, colours: Mapping[str, str], others: Sequence[Line2D] = ()) -> None:
    """Names in their colours along the top, in several rows if needed."""
    handles = [
        *(Line2D([], [], color=colour, label=name, lw=2) for name, colour in colours.items()),
        *others,
    ]
    # about, at this size of letters
    widths_in = [0.65 + 0.08 * len(str(handle.get_label())) for handle in handles]
    for columns in range(len(handles), 0, -1):
        parts = np.array_split(widths_in, columns)  # names run down the columns
        if sum(part.max() for part in parts) <= figure.get_figwidth():
            break
    figure.legend(handles=handles, loc="outside upper left", ncols=columns)


def plot_line(axes: Axes, x: npt.ArrayLike, y: npt.ArrayLike, **style: Any) -> None:
    """A line with gaps where ``y`` is NaN; a single value between two gaps is a dot."""
    known = np.isfinite(np.asarray(y, dtype=np.float64))
    padded = np.concatenate(([False], known, [False]))
    single = known & ~padded[:-2] & ~padded[2:]
    axes.plot(x, y, marker="o", markevery=single, **style)  # type: ignore[arg-type]


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
            f"{file}: no such file; expected the metrics.csv of a training run, give its run folder."
        )
    try:
        frame = pl.read_csv(file, infer_schema_length=None)
    except (PolarsError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"{file}: not a readable CSV file ({reason}); give a run's metrics.csv."
        ) from error
    if X_COLUMN not in frame.columns or frame.height == 0:
        raise UserError(
            f"{file}: expected a column '{X_COLUMN}' and at least one row; give a run's metrics.csv."
        )
    for column in frame.iter_columns():
        wrong = column.drop_nulls()
        if column.dtype.is_numeric():
            # Matplotlib cannot scale an axis for much larger numbers.
            wrong = wrong.filter(wrong.is_finite() & (wrong.abs() > 1e100))
        if wrong.len():
            found = str(wrong[0])[:40]
            raise UserError(
                f"{file}: column {column.name!r} holds {found!r}, expected numbers that one can draw; repair it."
            )
    return frame


def read_run(path: str | Path) -> pl.DataFrame:
    """``metrics.csv`` of a run's folder, merged with the rows of ``evaluation.csv`` if there is
    one.

    Returns:
        ``decisions`` and the columns of both files, those of the second with :data:`EVALUATION`
        before their names; null where a row is of the other file.

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


def read_runs(paths: Sequence[str | Path]) -> dict[str, list[pl.DataFrame]]:
    """Metrics (:func:`read_run`) of run folders, and of all runs in the folder of a sweep, by name.

    Names are those of :func:`ganlane.evaluation.results.names_of_runs`. Runs that differ in their
    seeds alone share one, without the seed.

    Raises:
        UserError: a folder comes twice, or cannot be read.
    """
    given = [Path(path).resolve() for path in paths]
    files = [
        path
        for each in given
        for path in (runs_below(each, "metrics.csv") if each.is_dir() else [each])
    ]
    files = files or given
    if len(set(files)) < len(files):
        raise UserError(
            f"run={','.join(map(str, paths))}: a folder comes twice; give each run once."
        )
    runs: dict[str, list[pl.DataFrame]] = {}
    for name, path in zip(
        names_of_runs([path if path.suffix != ".csv" else path.parent for path in files]), files
    ):
        runs.setdefault(re.sub(r"(^|, )seed=[^,]*$", "", name) or "all seeds", []).append(
            read_run(path)
        )
    return runs


def running_mean(values: FloatArray, window: int) -> FloatArray:
    """Mean over the last ``window`` values (fewer at the start), ignoring NaN.

    NaN where the value itself is.
    """
    known = np.isfinite(values)
    total = np.cumsum(np.where(known, values, 0.0))
    count = np.cumsum(known)
    total[window:], count[window:] = (
        total[window:] - total[:-window],
        count[window:] - count[:-window],
    )
    return np.where(known, total / np.maximum(count, 1), np.nan)


@rc_context(STYLE)
def draw_runs(
    runs: Mapping[str, Runs], columns: Sequence[str] | None = None, smooth: int = 1
) -> Figure:
    """Training runs over the number of decisions, one colour per name.

    Args:
        runs: name to metrics (:func:`read_run`), or to those of several seeds, of which the mean is
            drawn, in a band from the lowest to the highest.
        columns: one panel for each of these; by default those of :data:`PANELS` that any run has
            numbers for.
        smooth: rows that the running mean takes in; above 1 the rows themselves are drawn faintly.

    Raises:
        UserError: there is nothing to draw, or a column that no run has.
    """
    seeds = {
        name: [each] if isinstance(each, pl.DataFrame) else list(each)
        for name, each in runs.items()
    }
    # Columns in which any run has numbers.
    known = list(
        dict.fromkeys(
            name
            for frames in seeds.values()
            for frame in frames
            for name, kind in frame.schema.items()
            if kind.is_numeric() and name != X_COLUMN and frame[name].is_not_null().any()
        )
    )
    for name in columns or ():
        if name not in known:
            raise UserError(
                f"column {name}: no run has numbers there; choose among {', '.join(known)}."
            )
    chosen = (
        PANELS
        if columns is None
        else [Panel(words := name.replace("_", " "), name, words) for name in columns]
    )
    drawn = [panel for panel in chosen if panel.column in known]
    if not drawn:
        wanted = ", ".join(panel.column for panel in PANELS)
        raise UserError(
            f"run={','.join(runs)}: no numbers in any of {wanted}; give the folder of a training run."
        )
    figure, grid = panel_grid(len(drawn))
    colours = palette(list(runs))
    for axes, panel in zip(grid, drawn):
        axes.set(title=panel.title, ylabel=panel.label, xlabel=X_COLUMN)
        axes.xaxis.set_major_formatter(EngFormatter())
        for name, frames in seeds.items():
            _plot_column(axes, frames, panel.column, smooth, color=colours[name])
            _plot_column(
                axes, frames, panel.dashed, smooth, raw=False, color=colours[name], ls="--", lw=1.2
            )
    counts = {
        name: f" ({len(each)} seeds: mean, range)" if len(each) > 1 else ""
        for name, each in seeds.items()
    }
    add_legend(figure, {f"{name}{counts[name]}": colour for name, colour in colours.items()})
    return figure


def _plot_column(
    axes: Axes,
    frames: Sequence[pl.DataFrame],
    column: str,
    smooth: int,
    raw: bool = True,
    **style: Any,
) -> None:
    """A run's line for one column, if it has that column.

    Of several, their mean and range where all have values.
    """
    lines = []
    for frame in (each for each in frames if column in each.columns):
        table = frame.select(pl.col(X_COLUMN, column).cast(pl.Float64)).drop_nulls()
        x, y = table[X_COLUMN].to_numpy(), table[column].to_numpy()
        if smooth > 1 and raw and len(frames) == 1:
            plot_line(axes, x, y, **{**style, "alpha": 0.3, "lw": 0.8})
        lines.append((x, running_mean(y, smooth) if smooth > 1 else y))
    lines = [line for line in lines if len(line[0])]
    if len(lines) < 2:
        for x, y in lines:
            plot_line(axes, x, y, **style)
        return
    x = np.unique(np.concatenate([x for x, _ in lines]))
    x = x[(x >= max(each[0] for each, _ in lines)) & (x <= min(each[-1] for each, _ in lines))]
    values = np.stack([np.interp(x, *line) for line in lines])
    plot_line(axes, x, values.mean(0), **style)
    if raw:
        axes.fill_between(x, values.min(0), values.max(0), color=style["color"], alpha=0.18, lw=0)


def binned_density(histogram: Histogram, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Middles of about 80 bins (the histogram's own are finer) from ``low`` to ``high``, and the
    density there.
    """
    edges = histogram.bins.edges
    first, last = np.searchsorted(edges, (low - 1e-9, high - 1e-9))
    merged = max(1, int(last - first) // 80)
    number = int(last - first) // merged
    counts = histogram.counts[first : first + number * merged].reshape(number, merged).sum(axis=1)
    width = merged * float(edges[1] - edges[0])
    return edges[first] + width * (np.arange(number) + 0.5), counts / (
        max(histogram.total, 1) * width
    )


@rc_context(STYLE)
def draw_recordings(statistics: PooledStatistics) -> Figure:
    """Speeds, accelerations, lane-change times, headways and gaps of recorded driving, in six
    panels.
    """
    of = statistics.histograms
    fastest = min(60.0, 1.1 * of["speed"].quantile(1.0) + 1.0)
    figure, grid = panel_grid(6)
    densities = (
        (grid[0], "speed", "m/s", 0.0, fastest, {"": of["speed"]}),
        (grid[1], "acceleration", "m/s²", -5.0, 5.0,
         {"as recorded": of["acceleration_raw"], "over 1 s": of["acceleration_smoothed"]}),
        (grid[3], "followers' headway: median (gap - 2 m) / speed", "s", 0.0, 6.0, {"": of["headway"]}),
        (grid[4], "time headway: gap / speed", "s", 0.0, 8.0, {"": of["time_headway"]}),
        (grid[5], "gap to the leader", "m", 0.0, 100.0, {"": of["gap"]}),
    )  # fmt: skip
    for axes, title, unit, low, high, histograms in densities:
        axes.set(title=title, xlabel=unit, ylabel=f"density, per {unit}", xlim=(low, high))
        for line, ((label, histogram), colour) in enumerate(zip(histograms.items(), COLOURS)):
            middles, density = binned_density(histogram, low, high)
            axes.plot(middles, density, color=colour, label=label)
            beyond = 100.0 * (1.0 - float(np.sum(density)) * float(middles[1] - middles[0]))
            if histogram.total and beyond >= 0.05:
                text = f"{beyond:.1f} % beyond"
                axes.text(
                    0.99,
                    0.6 - 0.1 * line,
                    text,
                    ha="right",
                    color=colour,
                    size=8,
                    transform=axes.transAxes,
                )
        if len(histograms) > 1:
            axes.legend(loc="upper right", fontsize=8)
    # Share of lane changes that last longer: with unfinished ones as lower bounds (censored), and
    # without.
    axes = grid[2]
    axes.set(title="time to change lanes", xlabel="s", ylabel="share that lasts longer")
    changes = statistics.changes
    if not changes.complete.any():
        axes.text(
            0.5,
            0.5,
            "none recorded from start to end",
            ha="center",
            transform=axes.transAxes,
            color=FAINT,
        )
        return figure
    chosen = {
        "unfinished ones included": np.ones(len(changes), bool),
        "finished ones only": changes.complete,
    }
    for (label, those), colour in zip(chosen.items(), COLOURS):
        times, shares = survival_curve(changes.duration_s[those], changes.complete[those])
        axes.step(
            np.append(0.0, times), np.append(1.0, shares), where="post", color=colour, label=label
        )
    axes.legend(loc="upper right", fontsize=8)
    return figure
