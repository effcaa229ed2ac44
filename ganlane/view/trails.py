"""White lines that show where vehicles came from, as in the paper's Figure 3."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

_OVERSAMPLING = 2
#: Pixels around a trail that its width may reach into.
_MARGIN = 3
#: Coverage (0 to 255) of the oldest and the newest third of a trail, the ego's and the others'.
_EGO_COVERAGE = (110, 175, 240)
_OTHER_COVERAGE = (45, 80, 120)


def draw_trails(
    picture: Image.Image,
    columns: npt.NDArray[np.float64],
    rows: npt.NDArray[np.float64],
    known: npt.NDArray[np.bool_],
    edges: tuple[float, float],
) -> None:
    """Draw the trails of all vehicles, the ego's (index 0) brighter; older parts are fainter.

    Args:
        picture: drawn upon.
        columns, rows: pixels of the past positions, oldest first, [S, M].
        known: which of them belong to the trail, [S, M].
        edges: rows of the road's edges; trails are drawn between them and a margin.
    """
    top, bottom = int(edges[0]) - 20, int(edges[1]) + 20
    for vehicle in range(columns.shape[1] - 1, -1, -1):
        trail = np.stack((columns[:, vehicle], rows[:, vehicle]), axis=-1)[known[:, vehicle]]
        if len(trail) > 1:
            coverage = _EGO_COVERAGE if vehicle == 0 else _OTHER_COVERAGE
            _draw_trail(picture, trail, coverage, (top, bottom))


def _draw_trail(
    picture: Image.Image,
    trail: npt.NDArray[np.float64],
    coverage: tuple[int, int, int],
    bounds: tuple[int, int],
) -> None:
    """One trail, on a mask no larger than it is: a trail is long but hardly wide."""
    low, high = trail.min(axis=0), trail.max(axis=0)
    left, right = max(0, int(low[0]) - _MARGIN), min(picture.width, int(high[0]) + _MARGIN)
    top, bottom = max(bounds[0], int(low[1]) - _MARGIN), min(bounds[1], int(high[1]) + _MARGIN)
    if left >= right or top >= bottom:
        return
    mask = Image.new("L", ((right - left) * _OVERSAMPLING, (bottom - top) * _OVERSAMPLING))
    draw, points = ImageDraw.Draw(mask), (trail - (left, top)) * _OVERSAMPLING
    for part, strength in zip(_thirds(points), coverage):
        draw.line([(x, y) for x, y in part.tolist()], fill=strength, width=2 * _OVERSAMPLING)
    picture.paste((255, 255, 255), (left, top), mask.reduce(_OVERSAMPLING))


def _thirds(trail: npt.NDArray[np.float64]) -> list[npt.NDArray[np.float64]]:
    """The trail in three parts that share their ends, oldest first."""
    cuts = np.linspace(0, len(trail) - 1, 4).astype(int)
    return [trail[start : end + 1] for start, end in pairwise(cuts) if end > start]
