"""Vehicles as smooth little cars: boxes to scale, with glass, indicators and brake lights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.view import style
from ganlane.view.style import Colour
from ganlane.view.window import Window

FloatArray = npt.NDArray[np.float64]
#: Bodies are drawn so many times larger and reduced, which smooths their edges.
_OVERSAMPLING = 3
_SPEED_TEXT = 12

#: Outlines as shares of length (to the front) and width (to the left).
_BODY = np.array(
    [(-0.5, 0.42), (-0.46, 0.5), (0.38, 0.5), (0.5, 0.34), (0.5, -0.34), (0.38, -0.5), (-0.46, -0.5), (-0.5, -0.42)]
)
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


def _corners(body: Body, window: Window) -> tuple[FloatArray, FloatArray]:
    """Pixels per share of length and of width, each a vector (column, row), for the body as it is turned."""
    cos, sin = np.cos(body.heading), np.sin(body.heading)
    forward = np.array([cos * window.along, -sin * window.across]) * body.length_m
    left = np.array([-sin * window.along, -cos * window.across]) * body.width_m
    return forward, left


def draw_body(picture: Image.Image, body: Body, window: Window, show_speed: bool = True) -> None:
    """Draw a vehicle at its place, its speed in m/s on the roof."""
    forward, left = _corners(body, window)
    reach = np.ceil((np.abs(forward) + np.abs(left)) / 2 + 3).astype(int)
    origin = np.floor(np.array([body.column, body.row])).astype(int) - reach
    centre = (np.array([body.column, body.row]) - origin) * _OVERSAMPLING

    def outline(shares: FloatArray) -> list[tuple[float, float]]:
        points = centre + _OVERSAMPLING * (shares[:, :1] * forward + shares[:, 1:] * left)
        return [(x, y) for x, y in points.tolist()]

    size = (2 * reach + 1) * _OVERSAMPLING
    edge = style.CRASH if body.overlaps else style.mix(body.colour, (0, 0, 0), 0.65)
    patch = Image.new("RGBA", (int(size[0]), int(size[1])), (*edge, 0))
    _paint(ImageDraw.Draw(patch), body, outline, edge)
    smooth = patch.reduce(_OVERSAMPLING)
    picture.paste(smooth, (int(origin[0]), int(origin[1])), smooth)
    if show_speed:
        at = (body.column - 0.09 * forward[0], body.row - _SPEED_TEXT * 0.62)
        style.put_text(picture, at, f"{body.speed_mps:.0f}", _SPEED_TEXT, style.readable_on(body.colour), 0.5)


def _paint(draw: ImageDraw.ImageDraw, body: Body, outline, edge: Colour) -> None:  # type: ignore[no-untyped-def]
    """Paint body, glass and lights with ``outline`` turning shares into pixels."""
    draw.polygon(outline(_BODY), fill=(*edge, 255))
    inset = 0.86 if body.overlaps else 0.93
    draw.polygon(outline(_BODY * inset), fill=(*body.colour, 255))
    for glass in _GLASS:
        draw.polygon(outline(glass), fill=(*style.GLASS, 255))
    for light in _BRAKES if body.braking else ():
        draw.polygon(outline(light), fill=(*style.BRAKE, 255))
    for light in _INDICATORS_LEFT if body.signal else ():
        draw.polygon(outline(light * (1.0, body.signal)), fill=(*style.AMBER, 255))
