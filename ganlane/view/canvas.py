"""What frames are drawn with.

Colours, letters, metres to pixels, and the road, which does not move.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont
from PIL.ImageColor import getrgb

from ganlane.settings.render import FilmConfig
from ganlane.settings.road import EXIT, WALL, LaneStretch, Stretches

# Colours, as Pillow reads them.
HEADER = "#16181c"
VERGE = "#2a332e"
VERGE_STRIPE = "#2e3832"
ASPHALT = "#3d4045"
MARK = "#d6d6d0"
TEXT = "#f0f0ec"
FAINT = "#9499a0"
EGO = "#ff961c"
CRASH = "#ff3e3e"
GOOD = "#68d47e"
AMBER = "#ffd640"
BRAKE = "#ff3028"
#: Blue for the other vehicles, from standing to ``FAST_MPS``: red, green and blue of each.
_BLUES = (
    (38, 52, 128),
    (58, 122, 224),
    (158, 226, 255),
)
FAST_MPS = 35.0
#: Number of its levels.
_LEVELS = 36

#: Rows above and below the picture of the road, pixels.
HEADER_HEIGHT = 56
FOOTER_HEIGHT = 24
#: Height of the small letters, pixels.
SMALL = 12
#: Share of the road in the picture that lies behind the ego.
BEHIND = 0.38
#: The scale across the road is up to so many times that along it: vehicles and lateral movements
#: look wider than they are, overlaps stay overlaps.
EXAGGERATION = 1.5
#: Lane marks: 6 m and a gap of 12 m, as on motorways.
PERIOD_M = 18.0
DASH_M = 6.0
#: Posts beside the road with their distance from its start.
POST_EVERY_M = 50.0


def speed_tint(speed_mps: float) -> str:
    """Blue of a vehicle at this speed: dark at 0, pale at :data:`FAST_MPS` and above."""
    share = min(max(speed_mps / FAST_MPS, 0.0), 1.0)
    # In levels, from 0 to 2, the place of the last blue.
    place = 2.0 * round(share * _LEVELS) / _LEVELS
    # Red, green and blue, between the blues on both sides.
    channels = [np.interp(place, (0.0, 1.0, 2.0), channel) for channel in zip(*_BLUES)]
    return _hex_colour(channels)


def darker(colour: str) -> str:
    """A colour at about a third of its brightness."""
    return _hex_colour([0.35 * channel for channel in getrgb(colour)])


def _hex_colour(channels: Sequence[float]) -> str:
    """Red, green and blue, each from 0 to 255, as ``#rrggbb``."""
    return f"#{bytes(map(round, channels)).hex()}"


def readable_on(colour: str) -> str:
    """Black or white, whichever reads better on ``colour``."""
    # Luma of ITU-R BT.601, from 0 to 255.
    is_bright = np.dot((0.299, 0.587, 0.114), getrgb(colour)) > 130
    return "#101216" if is_bright else "white"


# A film writes the same numbers and headings in frame after frame: without the cache it is drawn at
# two thirds of the speed.
@lru_cache(maxsize=4096)
def text_mask(text: str, size: int) -> Image.Image:
    """The text as a coverage mask (mode L), cut to its ink across, and as high as a line."""
    # Pillow's own letters: no font has to be installed.
    letters = ImageFont.load_default(size)
    left, _, right, _ = letters.getbbox(text)
    # At least one pixel: an empty text has a mask too.
    width = max(1, round(right - left) + 1)
    height = round(size * 1.25)
    mask = Image.new("L", (width, height))
    ImageDraw.Draw(mask).text((-left, 0), text, fill=255, font=letters)
    return mask


def put_text(
    image: Image.Image,
    position: tuple[float, float],
    text: str,
    colour: str = FAINT,
    size: int = SMALL,
    anchor: float = 0.0,
) -> None:
    """Write a text onto ``image``.

    Args:
        image: the picture that is changed.
        position: column, and row of the text's top, pixels.
        text: what is written.
        colour: of the letters.
        size: of the letters, pixels.
        anchor: 0: the text starts at the column, 0.5: it is centred there, 1: it ends there.
    """
    mask = text_mask(text, size)
    column, row = position
    place = (round(column - anchor * mask.width), round(row))
    image.paste(colour, place, mask)


class Window:
    """The scale of a picture for a road of ``lanes`` lanes; rows of the picture count downwards.

    Args:
        look: size of the picture, pixels, and length of the road in it, m.
        lanes: number of lanes.
        lane_width_m: width of a lane, m.

    Attributes:
        width, height: of the picture, pixels.
        length_m: of the road in the picture.
        lanes, lane_width_m: as given.
        along, across: pixels per metre along and across the road. Across it they are exaggerated,
            but never more than the picture has room for.
        edges: rows of the left (upper) and right (lower) edge of the road.
    """

    def __init__(self, look: FilmConfig, lanes: int, lane_width_m: float) -> None:
        self.width = look.width
        self.height = look.height
        self.length_m = look.road_m
        self.lanes = lanes
        self.lane_width_m = lane_width_m

        # Rows between header and footer, and the one in their middle.
        room = look.height - HEADER_HEIGHT - FOOTER_HEIGHT
        self._middle = HEADER_HEIGHT + room / 2

        self.along = look.width / look.road_m
        # The road may not be higher than what header and footer leave, with 1 m of verge at each
        # side.
        most_across = room / (lanes * lane_width_m + 2.0)
        self.across = min(self.along * EXAGGERATION, most_across)

        # The centre of lane 0, the rightmost, is at y = 0.
        left_edge_m = (lanes - 0.5) * lane_width_m
        right_edge_m = -0.5 * lane_width_m
        upper, lower = self.row([left_edge_m, right_edge_m])
        self.edges = (float(upper), float(lower))

    def row(self, y_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Picture rows of lateral positions, m."""
        # The middle of the road is in the middle between header and footer.
        middle_m = 0.5 * (self.lanes - 1) * self.lane_width_m
        left_of_middle_m = np.asarray(y_m, dtype=np.float64) - middle_m
        return self._middle - left_of_middle_m * self.across

    def start(self, ego_x_m: float) -> float:
        """Where the picture begins, m along the road, with the ego at ``ego_x_m``."""
        return ego_x_m - BEHIND * self.length_m

    def column(self, x_m: npt.ArrayLike, ego_x_m: float) -> npt.NDArray[np.float64]:
        """Picture columns of positions along the road, m, with the ego at ``ego_x_m``."""
        from_start_m = np.asarray(x_m, dtype=np.float64) - self.start(ego_x_m)
        return from_start_m * self.along


class Backdrop:
    """Verges, asphalt, edge lines and dashed lane marks.

    Drawn once, one period wider than the picture. Where lanes begin and end is drawn on top.

    Args:
        window: scale of the picture.
        stretches: where each lane begins and ends, from the rightmost; empty: all go on for ever.

    Attributes:
        period: pixels after which the road looks the same.
        strip: the road without posts and ends of lanes.
    """

    def __init__(self, window: Window, stretches: Stretches = ()):
        self.window = window
        self.stretches = stretches

        # Two periods of lane marks, after which the verge's stripes repeat, too.
        self.period = round(2 * PERIOD_M * window.along)
        strip = Image.new("RGB", (window.width + self.period, window.height), VERGE)
        self.strip = strip
        draw = ImageDraw.Draw(strip)

        # Columns where periods of lane marks begin.
        half = self.period / 2
        starts = np.arange(0, strip.width, half)
        # Every second period's verge is a shade lighter, so that movement shows.
        for start in starts[::2]:
            draw.rectangle((start, 0, start + half - 1, strip.height), fill=VERGE_STRIPE)

        # Asphalt, a little beyond the edge lines.
        upper, lower = window.edges
        draw.rectangle((0, upper - 5, strip.width, lower + 5), fill=ASPHALT)
        for edge in window.edges:
            draw.line((0, edge, strip.width, edge), fill=MARK, width=3)

        # Dashes between the lanes.
        borders_m = (np.arange(window.lanes - 1) + 0.5) * window.lane_width_m
        dash = DASH_M * window.along
        for row in window.row(borders_m):
            for start in starts:
                draw.line((start, row, start + dash, row), fill=MARK, width=2)

    def at(self, ego_x_m: float) -> Image.Image:
        """A fresh picture of the road around the ego.

        Posts tell the distance from the start, m.
        """
        window = self.window
        # The strip repeats after a period, so the picture is cut out of it anywhere on the road.
        origin = float(window.column(0.0, ego_x_m))
        shift = round(-origin) % self.period
        picture = self.strip.crop((shift, 0, shift + window.width, window.height))
        draw = ImageDraw.Draw(picture)
        for lane, stretch in enumerate(self.stretches):
            self._draw_ends(draw, lane, stretch, ego_x_m)

        # 10 m more at both ends, where a post's number may still reach into the picture.
        start_m = window.start(ego_x_m)
        first_m = np.ceil((start_m - 10.0) / POST_EVERY_M) * POST_EVERY_M
        end_m = start_m + window.length_m + 10.0
        posts_m = np.arange(first_m, end_m, POST_EVERY_M)
        _, lower = window.edges
        for metres, column in zip(posts_m, window.column(posts_m, ego_x_m)):
            draw.line((column, lower + 7, column, lower + 20), fill=FAINT, width=2)
            put_text(picture, (column + 7, lower + 8), f"{int(metres)} m")
        return picture

    def _draw_ends(
        self, draw: ImageDraw.ImageDraw, lane: int, stretch: LaneStretch, ego_x_m: float
    ) -> None:
        """Where a lane begins and ends.

        No road before an exit lane and behind a wall, which is red; a kerb beside a ramp.
        """
        window = self.window
        is_leftmost = lane == window.lanes - 1
        # Within the picture's surroundings, since pixels of a lane without an end would overflow.
        far_m = window.length_m * 2.0
        ends_m = [stretch.begin_m, stretch.end_m]
        near_ends_m = np.clip(ends_m, ego_x_m - far_m, ego_x_m + far_m)
        begin, end = window.column(near_ends_m, ego_x_m).tolist()

        # Rows of the lane's left and right side.
        sides = (np.array([0.5, -0.5]) + lane) * window.lane_width_m
        upper, lower = window.row(sides).tolist()
        # The outermost lanes have an edge of asphalt.
        top = upper - 6 if is_leftmost else upper + 2
        bottom = lower + 6 if lane == 0 else lower - 2

        # Columns before and behind the lane: there is no road at one, and a ramp at the other. An
        # exit lane goes on as a ramp, any other begins as one.
        before = (0.0, begin)
        behind = (end, float(window.width))
        if stretch.end == EXIT:
            nothing, ramp = before, behind
        else:
            nothing, ramp = behind, before

        left, right = nothing
        if left < right:
            draw.rectangle((left, top, right, bottom), fill=VERGE)
        # A wall is 1 m thick.
        if stretch.end == WALL:
            draw.rectangle((end, top, end + window.along, bottom), fill=CRASH)

        # Kerbs between the ramp and the lanes beside it, unless it lies outside the picture.
        left, right = ramp
        if left >= right:
            return
        if not is_leftmost:
            draw.line((left, upper, right, upper), fill=VERGE, width=6)
        if lane > 0:
            draw.line((left, lower, right, lower), fill=VERGE, width=6)
