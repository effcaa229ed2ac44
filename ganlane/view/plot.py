"""A small line plot drawn with Pillow: axes with round ticks, lines, a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.view.style import Colour, put_text

FloatArray = npt.NDArray[np.float64]

PAPER: Colour = (255, 255, 255)
INK: Colour = (38, 42, 48)
GRID: Colour = (226, 229, 233)
FAINT: Colour = (110, 116, 124)
#: Okabe and Ito's colours, which read well for most eyes.
LINES: tuple[Colour, ...] = (
    (0, 114, 178),
    (230, 120, 0),
    (0, 158, 115),
    (204, 80, 140),
    (86, 160, 220),
    (170, 140, 0),
    (110, 110, 110),
)
#: Lines are drawn so many times larger and reduced, which smooths them.
_OVERSAMPLING = 3
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 16, 30, 36
#: Length of a dash and of the gap after it, pixels.
_DASH = 5


@dataclass(frozen=True)
class Line:
    """One line of a plot; where ``y`` is not a number the line has a gap."""

    x: FloatArray
    y: FloatArray
    colour: Colour = LINES[0]
    #: Drawn faintly below, for instance what ``y`` is a running mean of.
    raw: FloatArray | None = None
    dashed: bool = False


def ticks(low: float, high: float, wanted: int = 5) -> FloatArray:
    """Round numbers (1, 2 or 5 times a power of ten apart) within [low, high], about ``wanted`` of them."""
    rough = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= rough)
    first = math.ceil(low / step - 1e-9)
    return np.arange(first, math.floor(high / step + 1e-9) + 1, dtype=np.float64) * step


def tick_text(value: float, step: float) -> str:
    """A tick's number, short: 250 k, 1.5 M, 0.05."""
    for unit, name in ((1e6, " M"), (1e3, " k")):
        if step >= unit / 20 and abs(value) >= unit:
            return f"{value / unit:g}{name}"
    return f"{round(value, max(0, 1 - math.floor(math.log10(step)))):g}"


def _bounds(values: Sequence[FloatArray], margin: float) -> tuple[float, float]:
    """Smallest and largest finite value, ``margin`` times their distance further apart; never equal."""
    together = np.concatenate(values) if values else np.empty(0)
    finite = together[np.isfinite(together)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    if low == high:
        reach = 0.1 * abs(low) or 1.0
        return low - reach, high + reach
    return low - margin * (high - low), high + margin * (high - low)


class Panel:
    """One plot with its axes.

    Args:
        title: above it.
        lines: what is drawn, in this order.
        width, height: pixels.
        x_title: below the horizontal axis.
    """

    def __init__(self, title: str, lines: Sequence[Line], width: int, height: int, x_title: str = ""):
        self.title, self.lines, self.x_title = title, lines, x_title
        self.width, self.height = width, height
        self.x_bounds = _bounds([line.x for line in lines], 0.0)
        self.y_bounds = _bounds(
            [values for line in lines for values in (line.y, line.raw) if values is not None], 0.06
        )

    def _columns(self, x: npt.ArrayLike) -> FloatArray:
        low, high = self.x_bounds
        return _LEFT + (np.asarray(x, dtype=np.float64) - low) / (high - low) * (self.width - _LEFT - _RIGHT)

    def _rows(self, y: npt.ArrayLike) -> FloatArray:
        low, high = self.y_bounds
        return self.height - _BOTTOM - (np.asarray(y) - low) / (high - low) * (self.height - _TOP - _BOTTOM)

    def draw(self) -> Image.Image:
        """The plot."""
        picture = Image.new("RGB", (self.width, self.height), PAPER)
        self._draw_axes(picture)
        for line in self.lines:
            if line.raw is not None:
                self._draw_line(picture, line.x, line.raw, line.colour, strength=70, thickness=1)
        for line in self.lines:
            self._draw_line(picture, line.x, line.y, line.colour, 255, 2, line.dashed)
        return picture

    def _draw_axes(self, picture: Image.Image) -> None:
        """Grid, ticks and titles."""
        draw = ImageDraw.Draw(picture)
        put_text(picture, (_LEFT, 7), self.title, 14, INK)
        y_ticks, x_ticks = ticks(*self.y_bounds), ticks(*self.x_bounds)
        for value, row in zip(y_ticks, self._rows(y_ticks)):
            draw.line((_LEFT, row, self.width - _RIGHT, row), fill=GRID)
            text = tick_text(float(value), float(y_ticks[1] - y_ticks[0]) if len(y_ticks) > 1 else 1.0)
            put_text(picture, (_LEFT - 8, row - 8), text, 12, FAINT, 1.0)
        bottom = self.height - _BOTTOM
        for value, column in zip(x_ticks, self._columns(x_ticks)):
            draw.line((column, bottom, column, bottom + 4), fill=FAINT)
            text = tick_text(float(value), float(x_ticks[1] - x_ticks[0]) if len(x_ticks) > 1 else 1.0)
            put_text(picture, (column, bottom + 6), text, 12, FAINT, 0.5)
        draw.line((_LEFT, bottom, self.width - _RIGHT, bottom), fill=FAINT)
        put_text(picture, (self.width - _RIGHT, bottom + 20), self.x_title, 11, FAINT, 1.0)

    def _draw_line(
        self,
        picture: Image.Image,
        x: FloatArray,
        y: FloatArray,
        colour: Colour,
        strength: int,
        thickness: int,
        dashed: bool = False,
    ) -> None:
        """A smooth line, interrupted where ``y`` is not a number."""
        mask = Image.new("L", (self.width * _OVERSAMPLING, self.height * _OVERSAMPLING))
        draw = ImageDraw.Draw(mask)
        points = np.stack((self._columns(x), self._rows(y)), axis=1) * _OVERSAMPLING
        for run in np.split(points, np.flatnonzero(~np.isfinite(y))):
            known = run[np.isfinite(run).all(axis=1)].tolist()
            if len(known) > 1:
                path = [(a, b) for a, b in known]
                for part in _dashes(path) if dashed else [path]:
                    draw.line(part, fill=strength, width=thickness * _OVERSAMPLING, joint="curve")
            elif known:
                a, b = known[0]
                reach = 2 * _OVERSAMPLING
                draw.ellipse((a - reach, b - reach, a + reach, b + reach), fill=strength)
        picture.paste(colour, (0, 0), mask.reduce(_OVERSAMPLING))


def _dashes(path: Sequence[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    """A path as dashes with gaps of the same length, measured along it."""
    points = np.array(path)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    dash = float(_DASH * _OVERSAMPLING)
    found = []
    for start in np.arange(0.0, along[-1], 2 * dash):
        end = min(start + dash, along[-1])
        places = np.concatenate([[start], along[(along > start) & (along < end)], [end]])
        columns, rows = (np.interp(places, along, values).tolist() for values in points.T)
        found.append(list(zip(columns, rows)))
    return found
