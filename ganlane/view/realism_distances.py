"""Every traffic's realism card side by side: distances to recorded driving with their intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from PIL import Image, ImageDraw

from ganlane.view.plot import FAINT, GRID, INK, LINES, PAPER
from ganlane.view.style import Colour, put_text

#: Pixels: the names' column, the scale, a row per traffic, the space between quantities.
_LEFT, _SCALE, _ROW, _SPACE, _TOP, _BOTTOM = 190, 620, 13, 16, 44, 44
_RIGHT = 30
#: The scale's ends besides the traffics.
_MARKS: dict[str, Colour] = {"ceiling": INK, "floor": FAINT}
_LARGEST = 1.0


def draw_distances(quantities: Mapping[str, Any], traffic: str) -> Image.Image:
    """A block of rows per quantity: dot and interval of each traffic, ceiling and floor as upright lines.

    Args:
        quantities: rows of :func:`ganlane.evaluation.realism.card.quantity_rows`.
        traffic: the card's own.
    """
    others = list(next(iter(quantities.values()))["against"])
    colours = {name: LINES[index % len(LINES)] for index, name in enumerate([traffic, *others])}
    block = _ROW * len(colours) + _SPACE
    height = _TOP + block * len(quantities) + _BOTTOM
    sheet = Image.new("RGB", (_LEFT + _SCALE + _RIGHT, height), PAPER)
    _draw_scale(sheet, colours)
    for index, (name, row) in enumerate(quantities.items()):
        top = _TOP + index * block
        _draw_block(sheet, top, block, name, row)
        for line, (driver, colour) in enumerate(colours.items()):
            shown = row if driver == traffic else row["against"][driver]
            _draw_distance(sheet, top + (line + 0.5) * _ROW + 0.5 * _SPACE, shown, colour)
    return sheet


def _column(value: float) -> float:
    return _LEFT + min(value, _LARGEST) / _LARGEST * _SCALE


def _draw_scale(sheet: Image.Image, colours: Mapping[str, Colour]) -> None:
    """Grid, numbers and legend."""
    draw, bottom = ImageDraw.Draw(sheet), sheet.height - _BOTTOM
    for tenth in range(0, 11, 2):
        column = _column(tenth / 10)
        draw.line((column, _TOP, column, bottom), fill=GRID)
        put_text(sheet, (column, bottom + 4), f"{tenth / 10:g}", 12, FAINT, 0.5)
    put_text(sheet, (_LEFT + _SCALE, bottom + 20), "Jensen-Shannon distance to recorded driving", 12, FAINT, 1.0)
    left = 16.0
    for name, colour in {**colours, **_MARKS}.items():
        text = {"floor": "| random", "ceiling": "| half against half"}.get(name, name.rpartition(".")[2])
        if name not in _MARKS:
            draw.ellipse((left, 16, left + 9, 25), fill=colour)
        left += 14 + put_text(sheet, (left + 14, 12), text, 14, colour) + 18


def _draw_block(sheet: Image.Image, top: float, height: float, name: str, row: Mapping[str, Any]) -> None:
    """A quantity's name, and the ends of its scale."""
    draw = ImageDraw.Draw(sheet)
    draw.line((16, top, sheet.width - _RIGHT, top), fill=GRID)
    put_text(sheet, (16, top + 0.5 * height - 9), name.replace("_", " "), 14, INK)
    for mark, colour in _MARKS.items():
        if row[mark] is not None:
            column = _column(row[mark])
            draw.line((column, top + 3, column, top + height - 3), fill=colour, width=2)


def _draw_distance(sheet: Image.Image, middle: float, row: Mapping[str, Any], colour: Colour) -> None:
    """A dot with its interval; nothing where there is no distance."""
    if row["distance"] is None:
        return
    draw, column = ImageDraw.Draw(sheet), _column(row["distance"])
    if row["distance_ci"]:
        low, high = map(_column, row["distance_ci"])
        draw.line((low, middle, high, middle), fill=colour, width=2)
    draw.ellipse((column - 4, middle - 4, column + 4, middle + 4), fill=colour)
