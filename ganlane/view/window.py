"""Metres to pixels, and what does not move: the road and its marks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.errors import UserError
from ganlane.view import style

HEADER_HEIGHT = 56
FOOTER_HEIGHT = 24
#: Below these the header and the road have no room, pixels.
MIN_WIDTH, MIN_HEIGHT = 600, 160
#: Lane marks: 6 m and a gap of 12 m, as on motorways.
PERIOD_M = 18.0
DASH_M = 6.0
POST_EVERY_M = 50.0


@dataclass(frozen=True)
class WindowParameters:
    """Size of the picture in pixels and how much road it shows.

    Across the road the scale is up to ``lateral_exaggeration`` times that along it (less where many lanes
    need the room): vehicles and lateral movements look wider than they are, overlaps stay overlaps.
    """

    width: int = 1280
    height: int = 320
    #: Length of road in the picture, m.
    length_m: float = 160.0
    #: Share of it that lies behind the ego.
    behind: float = 0.38
    lateral_exaggeration: float = 1.5

    def __post_init__(self) -> None:
        if self.width < MIN_WIDTH or self.height < MIN_HEIGHT:
            raise UserError(
                f"picture of {self.width} x {self.height} pixels: at least {MIN_WIDTH} x {MIN_HEIGHT} are needed; "
                "draw it larger and scale the film down."
            )
        if not (self.length_m > 0 and 0 <= self.behind <= 1 and self.lateral_exaggeration > 0):
            raise UserError(
                f"picture of {self.length_m:g} m of road, {self.behind:g} behind, {self.lateral_exaggeration:g} "
                "times wider across: expected a length and a factor above 0 and a share from 0 to 1."
            )


@dataclass(frozen=True)
class Window:
    """The scale of a picture for a road of ``lanes`` lanes; rows of the picture count downwards."""

    parameters: WindowParameters
    lanes: int
    lane_width_m: float

    @property
    def along(self) -> float:
        """Pixels per metre along the road."""
        return self.parameters.width / self.parameters.length_m

    @property
    def across(self) -> float:
        """Pixels per metre across the road: exaggerated, but never more than the picture has room for."""
        room = self.parameters.height - HEADER_HEIGHT - FOOTER_HEIGHT
        wanted = self.along * self.parameters.lateral_exaggeration
        return min(wanted, room / (self.lanes * self.lane_width_m + 2.0))

    def row(self, y_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Picture rows of lateral positions, m."""
        middle = HEADER_HEIGHT + (self.parameters.height - HEADER_HEIGHT - FOOTER_HEIGHT) / 2
        centre = 0.5 * (self.lanes - 1) * self.lane_width_m
        return middle - (np.asarray(y_m, dtype=np.float64) - centre) * self.across

    def column(self, x_m: npt.ArrayLike, ego_x_m: float) -> npt.NDArray[np.float64]:
        """Picture columns of positions along the road, m, with the ego at ``ego_x_m``."""
        start = ego_x_m - self.parameters.behind * self.parameters.length_m
        return (np.asarray(x_m, dtype=np.float64) - start) * self.along

    @property
    def edges(self) -> tuple[float, float]:
        """Rows of the left (upper) and right (lower) edge of the road."""
        upper, lower = self.row([(self.lanes - 0.5) * self.lane_width_m, -0.5 * self.lane_width_m])
        return float(upper), float(lower)


class Backdrop:
    """Verges, asphalt, edge lines and dashed lane marks: drawn once, one period wider than the picture."""

    def __init__(self, window: Window):
        self.window = window
        self.period = round(2 * PERIOD_M * window.along)
        size = window.parameters
        self.strip = strip = Image.new("RGB", (size.width + self.period, size.height), style.VERGE)
        draw = ImageDraw.Draw(strip)
        half = self.period / 2
        upper, lower = window.edges
        starts = np.arange(0, strip.width, half)
        for start in starts[::2]:  # every second period's verge is a shade lighter so that movement shows
            draw.rectangle((start, 0, start + half - 1, size.height), fill=style.VERGE_STRIPE)
        draw.rectangle((0, upper - 5, strip.width, lower + 5), fill=style.ASPHALT)
        for edge in (upper, lower):
            draw.line((0, edge, strip.width, edge), fill=style.MARK, width=3)
        for mark in window.row((np.arange(window.lanes - 1) + 0.5) * window.lane_width_m):
            for start in starts:
                draw.line((start, mark, start + DASH_M * window.along, mark), fill=style.MARK, width=2)

    def at(self, ego_x_m: float) -> Image.Image:
        """A fresh picture of the road around the ego, with posts that tell the distance from the start, m."""
        shift = round(-float(self.window.column(0.0, ego_x_m))) % self.period
        size, (_, lower) = self.window.parameters, self.window.edges
        picture = self.strip.crop((shift, 0, shift + size.width, size.height))
        start = ego_x_m - size.behind * size.length_m
        first = np.ceil((start - 10.0) / POST_EVERY_M) * POST_EVERY_M
        posts = np.arange(first, start + size.length_m + 10.0, POST_EVERY_M)
        draw = ImageDraw.Draw(picture)
        for metres, column in zip(posts, self.window.column(posts, ego_x_m)):
            draw.line((column, lower + 7, column, lower + 20), fill=style.FAINT, width=2)
            style.put_text(picture, (column + 7, lower + 8), f"{int(metres)} m", 12, style.FAINT)
        return picture
