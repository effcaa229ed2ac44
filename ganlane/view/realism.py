"""Figures of the realism card: recorded and simulated distributions, and the drift of long runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.evaluation.realism import FLOORS, QUANTITIES, UNITS, Starts
from ganlane.files import atomic_path
from ganlane.view.plot import INK, LINES, PAPER, Line, Panel
from ganlane.view.realism_distances import draw_distances
from ganlane.view.style import Colour, put_text

RECORDED: Colour = INK
_WIDTH, _HEIGHT, _LEGEND, _ACROSS = 420, 240, 34, 3


def _sheet(panels: Sequence[Panel], legend: Mapping[str, Colour]) -> Image.Image:
    """Panels in rows of three below a legend."""
    across = min(_ACROSS, len(panels))
    down = -(-len(panels) // across)
    sheet = Image.new("RGB", (across * _WIDTH, down * _HEIGHT + _LEGEND), PAPER)
    for index, panel in enumerate(panels):
        sheet.paste(panel.draw(), (index % across * _WIDTH, index // across * _HEIGHT + _LEGEND))
    draw, column = ImageDraw.Draw(sheet), 64
    for name, colour in legend.items():
        draw.line((column, 20, column + 22, 20), fill=colour, width=3)
        column += 30 + put_text(sheet, (column + 30, 11), name, 14, INK) + 28
    return sheet


def _colours(names: Sequence[str]) -> dict[str, Colour]:
    return {name: LINES[index % len(LINES)] for index, name in enumerate(names)}


def draw_distributions(
    edges: Mapping[str, npt.NDArray[np.float64]],
    recorded: Mapping[str, npt.NDArray[np.float64]],
    simulated: Mapping[str, Mapping[str, npt.NDArray[np.float64]]],
    units: Mapping[str, str],
) -> Image.Image:
    """One panel per quantity: the recorded density, and each traffic's.

    Args:
        edges: by quantity, of its bins [B + 1].
        recorded: by quantity, counts [B].
        simulated: by traffic, then quantity.
        units: by quantity.
    """
    colours = _colours(list(simulated))
    panels = []
    for name, bounds in edges.items():
        middle, width = 0.5 * (bounds[1:] + bounds[:-1]), np.diff(bounds)
        every = [(counts[name], colours[traffic]) for traffic, counts in simulated.items()]
        lines = [
            Line(middle, counts / max(float(counts.sum()), 1.0) / width, colour)
            for counts, colour in [*every, (recorded[name], RECORDED)]
        ]
        panels.append(Panel(f"{name.replace('_', ' ')}, density", lines, _WIDTH, _HEIGHT, units[name]))
    return _sheet(panels, {"recorded": RECORDED, **colours})


def draw_drift(runs: Sequence[Mapping[str, Any]], spread_mps: float) -> Image.Image:
    """Mean and spread of the speeds of long runs over time; the recorded spread as a level.

    Args:
        runs: as :func:`ganlane.evaluation.realism.long_summary.summary` gives them.
        spread_mps: the recorded mean spread within a frame.
    """
    legend = _colours([f"{run['vehicles']} vehicles" for run in runs])
    panels = []
    for key, title in (("mean_speed_mps", "mean speed, m/s"), ("spread_mps", "spread of speeds, m/s")):
        lines = []
        for run, colour in zip(runs, legend.values()):
            timed = [(float(time.split()[0]), at[key]) for time, at in run["speeds"].items() if time.endswith(" s")]
            x, y = (np.array([np.nan if v is None else v for v in values]) for values in zip(*timed))
            lines.append(Line(x, y, colour))
        if key == "spread_mps" and lines:
            lines.append(Line(lines[0].x, np.full_like(lines[0].x, spread_mps), RECORDED))
        panels.append(Panel(title, lines, _WIDTH, _HEIGHT, "s"))
    return _sheet(panels, {"recorded": RECORDED, **legend})


def card_pictures(
    starts: Starts, runs: Sequence[Mapping[str, Any]], quantities: Mapping[str, Any], traffic: str
) -> dict[str, Image.Image]:
    """The pictures of a card by name: ``distributions``, ``distances``, and ``drift`` if there are long runs.

    Args:
        starts: everybody from the same starts.
        runs: the traffic's long runs.
        quantities: its rows.
        traffic: its name.
    """
    simulated = {
        name.rpartition(".")[2]: {quantity: counts.sum(0) for quantity, counts in driven.counts.items()}
        for name, driven in starts.driven.items()
        if name not in FLOORS
    }
    edges = {name: bins.edges for name, bins in QUANTITIES.items()}
    recorded = {name: counts.sum(0) for name, counts in starts.recorded.items()}
    pictures = {
        "distributions": draw_distributions(edges, recorded, simulated, UNITS),
        "distances": draw_distances(quantities, traffic),
    }
    return pictures | ({"drift": draw_drift(runs, starts.reference.spread_mps)} if runs else {})


def write_figure(picture: Image.Image, path: Path) -> Path:
    """Write a picture as PNG, atomically."""
    with atomic_path(path) as part:
        picture.save(part, format="PNG", optimize=True)
    return path
