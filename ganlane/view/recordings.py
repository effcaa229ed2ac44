"""Figures of recorded driving: what ``ganlane prepare`` measured, as one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ganlane.data import Histogram, PooledStatistics, survival_curve
from ganlane.files import atomic_path
from ganlane.view.plot import LINES, PAPER, Line, Panel
from ganlane.view.style import put_text

_WIDTH, _HEIGHT, _ACROSS = 480, 270, 3
#: Bins in a figure; the histograms' own are finer.
_DRAWN_BINS = 80


def density_line(histogram: Histogram, low: float, high: float, colour: int = 0) -> Line:
    """Probability density between ``low`` and ``high`` in about 80 bins, at their middles.

    Args:
        histogram: of the quantity; it must reach as far as ``low`` and ``high``.
        low, high: what is drawn, in the quantity's unit.
        colour: number of the line's colour.
    """
    edges = histogram.bins.edges
    first, last = np.searchsorted(edges, (low - 1e-9, high - 1e-9))
    merged = max(1, int(last - first) // _DRAWN_BINS)
    number = int(last - first) // merged
    counts = histogram.counts[first : first + number * merged].reshape(number, merged).sum(axis=1)
    width = merged * float(edges[1] - edges[0])
    middles = edges[first] + width * (np.arange(number) + 0.5)
    return Line(middles, counts / (max(histogram.total, 1) * width), LINES[colour])


def _panels(statistics: PooledStatistics) -> list[tuple[Panel, Sequence[str]]]:
    """Each panel, and what its lines are."""
    of = statistics.histograms
    fastest = min(60.0, 1.1 * of["speed"].quantile(1.0) + 1.0)
    raw, smoothed = (
        density_line(of[name], -5.0, 5.0, k) for k, name in enumerate(("acceleration_raw", "acceleration_smoothed"))
    )

    durations = _durations(statistics)
    told = ("still changing", "complete ones alone") if durations else ("none seen from start to end",)

    def plot(title: str, lines: Sequence[Line], unit: str) -> Panel:
        return Panel(title, lines, _WIDTH, _HEIGHT, unit)

    return [
        (plot("speed", [density_line(of["speed"], 0.0, fastest)], "m/s"), ()),
        (plot("acceleration", [raw, smoothed], "m/s2"), ("as recorded", "over 1 s")),
        (plot("time to change lanes", durations, "s"), told),
        (plot("followers' headway: median (gap - 2 m) / speed", [density_line(of["headway"], 0.0, 6.0)], "s"), ()),
        (plot("time headway: gap / speed", [density_line(of["time_headway"], 0.0, 8.0)], "s"), ()),
        (plot("gap to the leader", [density_line(of["gap"], 0.0, 100.0)], "m"), ()),
    ]


def _durations(statistics: PooledStatistics) -> list[Line]:
    """Share of lane changes that last longer: censored ones taken as lower bounds, and left out; none without any."""
    changes = statistics.changes
    if not changes.complete.any():
        return []
    lines = []
    for colour, chosen in enumerate((np.ones(len(changes), bool), changes.complete)):
        times, shares = survival_curve(changes.duration_s[chosen], changes.complete[chosen])
        stairs = np.repeat(np.concatenate(([1.0], shares)), 2)[:-1]
        lines.append(Line(np.concatenate(([0.0], np.repeat(times, 2))), stairs, LINES[colour]))
    return lines


def draw_recordings(statistics: PooledStatistics) -> Image.Image:
    """Speeds, accelerations, lane-change times, headways and gaps, six panels on one sheet."""
    panels = _panels(statistics)
    sheet = Image.new("RGB", (_ACROSS * _WIDTH, -(-len(panels) // _ACROSS) * _HEIGHT), PAPER)
    for index, (panel, names) in enumerate(panels):
        picture = panel.draw()
        for row, name in enumerate(names):
            put_text(picture, (_WIDTH - 24, 34 + 16 * row), name, 12, LINES[row], 1.0)
        sheet.paste(picture, (index % _ACROSS * _WIDTH, index // _ACROSS * _HEIGHT))
    return sheet


def write_recordings(statistics: PooledStatistics, path: str | Path) -> Path:
    """Draw the sheet as a PNG file, atomically."""
    sheet = draw_recordings(statistics)
    with atomic_path(path) as part:
        sheet.save(part, format="PNG", optimize=True)
    return Path(path)
