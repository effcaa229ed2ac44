"""What lies still: the road and its marks, drawn once and shifted under the vehicles frame by frame."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from ganlane.view import style
from ganlane.view.window import Window

#: A dash every so many metres, and its length: 6 m and a gap of 12 m, as on motorways.
PERIOD_M = 18.0
DASH_M = 6.0
POST_EVERY_M = 50.0


class Backdrop:
    """Verges, asphalt, edge lines and dashed lane marks, one period wider than the picture."""

    def __init__(self, window: Window):
        self.window = window
        self.period = round(2 * PERIOD_M * window.along)
        self.strip = self._draw()

    def _draw(self) -> Image.Image:
        """The strip, with every second period's verge a shade lighter so that movement shows."""
        window, size = self.window, self.window.parameters
        strip = Image.new("RGB", (size.width + self.period, size.height), style.VERGE)
        draw = ImageDraw.Draw(strip)
        half = self.period / 2
        upper, lower = window.edges
        starts = np.arange(0, strip.width, half)
        for start in starts[::2]:
            draw.rectangle((start, 0, start + half - 1, size.height), fill=style.VERGE_STRIPE)
        draw.rectangle((0, upper - 5, strip.width, lower + 5), fill=style.ASPHALT)
        for edge in (upper, lower):
            draw.line((0, edge, strip.width, edge), fill=style.MARK, width=3)
        for mark in window.row((np.arange(window.lanes - 1) + 0.5) * window.lane_width_m):
            for start in starts:
                draw.line((start, mark, start + DASH_M * window.along, mark), fill=style.MARK, width=2)
        return strip

    def at(self, ego_x_m: float) -> Image.Image:
        """A fresh picture of the road around the ego, with distance posts below it."""
        shift = round(-float(self.window.column(0.0, ego_x_m))) % self.period
        size = self.window.parameters
        picture = self.strip.crop((shift, 0, shift + size.width, size.height))
        self._posts(picture, ego_x_m)
        return picture

    def _posts(self, picture: Image.Image, ego_x_m: float) -> None:
        """Posts at every 50 m, with the distance from the start in m."""
        size, (_, lower) = self.window.parameters, self.window.edges
        start = ego_x_m - size.behind * size.length_m
        first = np.ceil((start - 10.0) / POST_EVERY_M) * POST_EVERY_M
        posts = np.arange(first, start + size.length_m + 10.0, POST_EVERY_M)
        draw = ImageDraw.Draw(picture)
        for metres, column in zip(posts, self.window.column(posts, ego_x_m)):
            draw.line((column, lower + 7, column, lower + 20), fill=style.FAINT, width=2)
            style.put_text(picture, (column + 7, lower + 8), f"{int(metres)} m", 12, style.FAINT)
