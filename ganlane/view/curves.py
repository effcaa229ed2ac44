"""Learning curves of one or more runs, from the ``metrics.csv`` that training writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl
from PIL import Image, ImageDraw
from polars.exceptions import PolarsError

from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.view.plot import INK, LINES, PAPER, Line, Panel
from ganlane.view.style import put_text

FloatArray = npt.NDArray[np.float64]

X_COLUMN = "decisions"
#: Drawn first, in this order, where a run has them.
PREFERRED = ("mean_return", "crash_rate", "eval_mean_return", "mean_speed_mps", "lane_changes_per_km", "loss")
_PANEL_WIDTH, _PANEL_HEIGHT, _LEGEND_HEIGHT, _MAX_COLUMNS = 480, 260, 34, 3


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


def running_mean(values: FloatArray, window: int) -> FloatArray:
    """Mean over the last ``window`` values that are numbers (fewer at the start); a gap where the value is none."""
    known = np.isfinite(values)
    total = np.cumsum(np.where(known, values, 0.0))
    count = np.cumsum(known)
    total[window:], count[window:] = total[window:] - total[:-window], count[window:] - count[:-window]
    return np.where(known, total / np.maximum(count, 1), np.nan)


def _chosen_columns(runs: Mapping[str, pl.DataFrame], wanted: Sequence[str] | None) -> list[str]:
    """Columns to draw: the ``wanted`` ones, or the preferred ones and then every other number."""
    numeric = [
        name
        for frame in runs.values()
        for name, kind in frame.schema.items()
        if kind.is_numeric() and name != X_COLUMN and frame[name].is_not_null().any()
    ]
    known = list(dict.fromkeys(numeric))
    if wanted is None:
        return sorted(known, key=lambda name: PREFERRED.index(name) if name in PREFERRED else len(PREFERRED))
    for name in wanted:
        if name not in known:
            raise UserError(f"column {name}: no run has numbers there; choose among {', '.join(known)}.")
    return list(wanted)


def draw_curves(
    runs: Mapping[str, pl.DataFrame], columns: Sequence[str] | None = None, smooth: int = 1
) -> Image.Image:
    """One panel per column, one line per run, over the number of decisions.

    Args:
        runs: name to metrics (:func:`read_metrics`).
        columns: what to draw; by default everything that is a number.
        smooth: rows that the running mean takes in; above 1 the rows themselves are drawn faintly.

    Raises:
        UserError: there is no run, nothing to draw, or a column that no run has.
    """
    names = _chosen_columns(runs, columns)
    if not names:
        raise UserError("learning curves: the runs have no numbers to draw; give the metrics.csv of a training run.")
    panels = [curve_panel(name.replace("_", " "), lines_of(runs, name, smooth)) for name in names]
    return curve_sheet(panels, list(runs))


def curve_panel(title: str, lines: Sequence[Line]) -> Image.Image:
    """One panel over the number of decisions."""
    return Panel(title, lines, _PANEL_WIDTH, _PANEL_HEIGHT, X_COLUMN).draw()


def curve_sheet(panels: Sequence[Image.Image], names: Sequence[str]) -> Image.Image:
    """Panels side by side, below the runs' ``names`` in their colours."""
    across = min(_MAX_COLUMNS, len(panels))
    down = -(-len(panels) // across)
    sheet = Image.new("RGB", (across * _PANEL_WIDTH, down * _PANEL_HEIGHT + _LEGEND_HEIGHT), PAPER)
    for index, panel in enumerate(panels):
        sheet.paste(panel, (index % across * _PANEL_WIDTH, index // across * _PANEL_HEIGHT + _LEGEND_HEIGHT))
    _draw_legend(sheet, names)
    return sheet


def lines_of(runs: Mapping[str, pl.DataFrame], name: str, smooth: int = 1, dashed: bool = False) -> list[Line]:
    """The runs' lines for one column; a run keeps its colour in every panel.

    Args:
        runs: see :func:`draw_curves`.
        name: of the column; a run that has none is left out.
        smooth: rows that the running mean takes in; above 1 the rows themselves are drawn faintly.
        dashed: draw broken lines.
    """
    lines = []
    for index, frame in enumerate(runs.values()):
        if name not in frame.columns:
            continue
        table = frame.select(pl.col(X_COLUMN, name).cast(pl.Float64)).drop_nulls()
        x, y = table[X_COLUMN].to_numpy(), table[name].to_numpy()
        colour = LINES[index % len(LINES)]
        smoothed = running_mean(y, smooth) if smooth > 1 else y
        lines.append(Line(x, smoothed, colour, y if smooth > 1 and not dashed else None, dashed))
    return lines


def _draw_legend(sheet: Image.Image, names: Sequence[str]) -> None:
    """The runs' names in their colours, along the top."""
    draw, column = ImageDraw.Draw(sheet), 64
    for index, name in enumerate(names):
        draw.line((column, 20, column + 22, 20), fill=LINES[index % len(LINES)], width=3)
        column += 30 + put_text(sheet, (column + 30, 11), name, 14, INK) + 28


def write_curves(
    runs: Mapping[str, str | Path], path: str | Path, columns: Sequence[str] | None = None, smooth: int = 1
) -> Path:
    """Draw the learning curves of ``runs`` (name to run folder or metrics.csv) as a PNG file, atomically."""
    sheet = draw_curves({name: read_metrics(source) for name, source in runs.items()}, columns, smooth)
    with atomic_path(path) as part:
        sheet.save(part, format="PNG", optimize=True)
    return Path(path)
