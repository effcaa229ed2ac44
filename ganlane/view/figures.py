"""The common style of all charts: colours, rows of panels, legends, and files.

Figures are made without pyplot: they need no display, and no global list keeps them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ganlane.errors import UserError
from ganlane.files import atomic_path

# It reports every table of a font that a PDF leaves out.
logging.getLogger("fontTools").setLevel(logging.WARNING)

FloatArray = npt.NDArray[np.float64]

INK = "#262a30"
FAINT = "#6e747c"
GRID = "#e2e5e9"
#: Okabe and Ito's palette, which colour-blind readers tell apart, with grey for its yellow (too
#: pale on white).
COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#56b4e9",
    "#e69f00",
    "#7f7f7f",
)
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


def palette(names: Sequence[str]) -> dict[str, str]:
    """A colour for each name; after seven they repeat."""
    return {name: COLOURS[index % len(COLOURS)] for index, name in enumerate(names)}


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure, atomically, in the format of the file's ending (one of :data:`FORMATS`).

    Raises:
        UserError: another format.
    """
    kind = Path(path).suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise UserError(
            f"{path}: a figure is one of {', '.join(FORMATS)}; give the file one of these endings."
        )
    with atomic_path(path) as part, rc_context(STYLE):
        figure.savefig(part, format=kind, metadata=FORMATS[kind])
    return Path(path)


def panel_grid(count: int) -> tuple[Figure, list[Axes]]:
    """A figure with ``count`` panels, three in a row, and room for a legend above."""
    across = min(3, count)
    # -(-a // b) is a / b rounded up.
    down = -(-count // across)
    # Width and height in inches.
    figure = Figure(figsize=(across * 4.0, down * 2.3 + 0.3))
    grid = figure.subplots(down, across, squeeze=False).ravel()
    for unused in grid[count:]:
        unused.remove()
    return figure, list(grid[:count])


def add_legend(figure: Figure, colours: Mapping[str, str], others: Sequence[Line2D] = ()) -> None:
    """Names in their colours along the top, in several rows if needed.

    Args:
        figure: where the legend is put.
        colours: of the lines, by their names.
        others: further entries, at the end.
    """
    handles = [Line2D([], [], color=colours[name], label=name, lw=2) for name in colours]
    handles += others
    # Inches, about, at this size of letters.
    widths_in = [0.65 + 0.08 * len(str(handle.get_label())) for handle in handles]
    # As many columns as fit into the figure's width; names run down the columns.
    for columns in range(len(handles), 0, -1):
        parts = np.array_split(widths_in, columns)
        if sum(part.max() for part in parts) <= figure.get_figwidth():
            break
    figure.legend(handles=handles, loc="outside upper left", ncols=columns)


def plot_line(axes: Axes, x: npt.ArrayLike, y: npt.ArrayLike, **style: Any) -> None:
    """A line with gaps where ``y`` is NaN; a single value between two gaps is a dot."""
    finite = np.isfinite(np.asarray(y, dtype=np.float64))
    # A value is single if it is finite and neither neighbour is; the ends count as gaps.
    padded = np.concatenate(([False], finite, [False]))
    single = finite & ~padded[:-2] & ~padded[2:]
    axes.plot(x, y, marker="o", markevery=single, **style)  # type: ignore[arg-type]
