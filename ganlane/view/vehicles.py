"""Vehicles as boxes to scale with glass, indicators and brake lights, and the white trails behind them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.view import style
from ganlane.view.style import Colour
from ganlane.view.window import Window

FloatArray = npt.NDArray[np.float64]
#: Bodies and trails are drawn so many times larger and reduced, which smooths their edges.
_BODY_OVERSAMPLING, _TRAIL_OVERSAMPLING = 3, 2
_SPEED_TEXT = 12
#: Pixels around a trail that its width may reach into.
_TRAIL_MARGIN = 3
#: Coverage (0 to 255) of the oldest, middle and newest third of a trail, the ego's and the others'.
_EGO_COVERAGE = (110, 175, 240)
_OTHER_COVERAGE = (45, 80, 120)

#: Outlines as shares of length (to the front) and width (to the left).
_BODY = np.array(
    [(-0.5, 0.42), (-0.46, 0.5), (0.38, 0.5), (0.5, 0.34), (0.5, -0.34), (0.38, -0.5), (-0.46, -0.5), (-0.5, -0.42)]
)
#: The ego's own shape: pointed, with a white edge.
_EGO = np.array([(-0.5, 0.5), (0.2, 0.5), (0.5, 0.08), (0.5, -0.08), (0.2, -0.5), (-0.5, -0.5)])
_GLASS = (
    np.array([(0.14, 0.42), (0.27, 0.34), (0.27, -0.34), (0.14, -0.42)]),
    np.array([(-0.38, 0.36), (-0.31, 0.40), (-0.31, -0.40), (-0.38, -0.36)]),
)
_BRAKES = (
    np.array([(-0.5, 0.42), (-0.44, 0.42), (-0.44, 0.2), (-0.5, 0.2)]),
    np.array([(-0.5, -0.42), (-0.44, -0.42), (-0.44, -0.2), (-0.5, -0.2)]),
)
_INDICATORS_LEFT = (
    np.array([(0.32, 0.5), (0.38, 0.5), (0.5, 0.34), (0.5, 0.2), (0.40, 0.26)]),
    np.array([(-0.46, 0.5), (-0.36, 0.5), (-0.40, 0.28), (-0.5, 0.24), (-0.5, 0.42)]),
)


@dataclass(frozen=True)
class Body:
    """One vehicle of one frame."""

    #: Pixels of its centre.
    column: float
    row: float
    heading: float
    length_m: float
    width_m: float
    speed_mps: float
    colour: Colour
    braking: bool = False
    #: +1 signals to the left, -1 to the right, 0 not.
    signal: int = 0
    overlaps: bool = False
    is_ego: bool = False


def draw_body(picture: Image.Image, body: Body, window: Window, show_speed: bool = True) -> None:
    """Draw a vehicle, with its speed in m/s on the roof."""
    # Pixels (column, row) per share of length and of width.
    cos, sin = np.cos(body.heading), np.sin(body.heading)
    forward = np.array([cos * window.along, -sin * window.across]) * body.length_m
    left = np.array([-sin * window.along, -cos * window.across]) * body.width_m
    reach = np.ceil((np.abs(forward) + np.abs(left)) / 2 + 3).astype(int)
    origin = np.floor(np.array([body.column, body.row])).astype(int) - reach
    centre = (np.array([body.column, body.row]) - origin) * _BODY_OVERSAMPLING

    def outline(shares: FloatArray) -> list[tuple[float, float]]:
        points = centre + _BODY_OVERSAMPLING * (shares[:, :1] * forward + shares[:, 1:] * left)
        return [(x, y) for x, y in points.tolist()]

    size = (2 * reach + 1) * _BODY_OVERSAMPLING
    plain = style.TEXT if body.is_ego else style.mix(body.colour, (0, 0, 0), 0.65)
    edge = style.CRASH if body.overlaps else plain
    patch = Image.new("RGBA", (int(size[0]), int(size[1])), (*edge, 0))
    draw = ImageDraw.Draw(patch)
    draw.polygon(outline(_EGO if body.is_ego else _BODY), fill=(*edge, 255))
    inset = 0.86 if body.overlaps or body.is_ego else 0.93
    draw.polygon(outline((_EGO if body.is_ego else _BODY) * inset), fill=(*body.colour, 255))
    for glass in _GLASS[1:] if body.is_ego else _GLASS:
        draw.polygon(outline(glass), fill=(*style.GLASS, 255))
    for light in _BRAKES if body.braking else ():
        draw.polygon(outline(light), fill=(*style.BRAKE, 255))
    for light in _INDICATORS_LEFT if body.signal else ():
        draw.polygon(outline(light * (1.0, body.signal)), fill=(*style.AMBER, 255))
    smooth = patch.reduce(_BODY_OVERSAMPLING)
    picture.paste(smooth, (int(origin[0]), int(origin[1])), smooth)
    if show_speed:
        at = (body.column - 0.09 * forward[0], body.row - _SPEED_TEXT * 0.62)
        style.put_text(picture, at, f"{body.speed_mps:.0f}", _SPEED_TEXT, style.readable_on(body.colour), 0.5)


def draw_trails(
    picture: Image.Image,
    columns: FloatArray,
    rows: FloatArray,
    known: npt.NDArray[np.bool_],
    edges: tuple[float, float],
) -> None:
    """Draw the trails of all vehicles, as in the paper's Figure 3: the ego's (index 0) brighter, older parts fainter.

    Args:
        picture: drawn upon.
        columns, rows: pixels of the past positions, oldest first, [S, M].
        known: which of them belong to the trail, [S, M].
        edges: rows of the road's edges; trails are drawn between them and a margin.
    """
    bounds = int(edges[0]) - 20, int(edges[1]) + 20
    for vehicle in range(columns.shape[1] - 1, -1, -1):
        trail = np.stack((columns[:, vehicle], rows[:, vehicle]), axis=-1)[known[:, vehicle]]
        if len(trail) > 1:
            _draw_trail(picture, trail, _EGO_COVERAGE if vehicle == 0 else _OTHER_COVERAGE, bounds)


def _draw_trail(
    picture: Image.Image, trail: FloatArray, coverage: tuple[int, int, int], bounds: tuple[int, int]
) -> None:
    """One trail in three parts that share their ends, on a mask no larger than it is."""
    low, high = trail.min(axis=0), trail.max(axis=0)
    left, right = max(0, int(low[0]) - _TRAIL_MARGIN), min(picture.width, int(high[0]) + _TRAIL_MARGIN)
    top, bottom = max(bounds[0], int(low[1]) - _TRAIL_MARGIN), min(bounds[1], int(high[1]) + _TRAIL_MARGIN)
    if left >= right or top >= bottom:
        return
    mask = Image.new("L", ((right - left) * _TRAIL_OVERSAMPLING, (bottom - top) * _TRAIL_OVERSAMPLING))
    draw, points = ImageDraw.Draw(mask), (trail - (left, top)) * _TRAIL_OVERSAMPLING
    cuts = np.linspace(0, len(points) - 1, 4).astype(int)
    parts = [points[start : end + 1] for start, end in pairwise(cuts) if end > start]
    for part, strength in zip(parts, coverage):
        draw.line([(x, y) for x, y in part.tolist()], fill=strength, width=2 * _TRAIL_OVERSAMPLING)
    picture.paste((255, 255, 255), (left, top), mask.reduce(_TRAIL_OVERSAMPLING))
