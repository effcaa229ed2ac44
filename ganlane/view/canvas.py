"""What frames are drawn with.

Colours, letters, metres to pixels, and the road, which does not move.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from ganlane.errors import UserError

Colour = tuple[int, int, int]

HEADER: Colour = (22, 24, 28)
VERGE: Colour = (42, 51, 46)
VERGE_STRIPE: Colour = (46, 56, 50)
ASPHALT: Colour = (61, 64, 69)
MARK: Colour = (214, 214, 208)
TEXT: Colour = (240, 240, 236)
FAINT: Colour = (148, 153, 160)
EGO: Colour = (255, 150, 28)
CRASH: Colour = (255, 62, 62)
GOOD: Colour = (104, 212, 126)
AMBER: Colour = (255, 214, 64)
BRAKE: Colour = (255, 48, 40)
GLASS: Colour = (24, 28, 36)
LEADER: Colour = (120, 230, 190)
#: Blue for the other vehicles, from standing to ``FAST_MPS``, in so many levels.
_SLOW, _MIDDLE, _FAST = (38, 52, 128), (58, 122, 224), (158, 226, 255)
FAST_MPS, _TINTS = 35.0, 36

HEADER_HEIGHT, FOOTER_HEIGHT = 56, 24
#: Below these the header and the road have no room, pixels.
MIN_WIDTH, MIN_HEIGHT = 600, 160
#: Lane marks: 6 m and a gap of 12 m, as on motorways.
PERIOD_M, DASH_M = 18.0, 6.0
POST_EVERY_M = 50.0


def mix(first: Colour, second: Colour, share: float) -> Colour:
    """``first`` with ``share`` (0 to 1) of ``second``."""
    a, b = np.array(first), np.array(second)
    red, green, blue = np.rint(a + (b - a) * share).astype(int).tolist()
    return red, green, blue


@lru_cache(maxsize=_TINTS + 1)
def _tint(level: int) -> Colour:
    share = 2.0 * level / _TINTS
    return mix(_SLOW, _MIDDLE, share) if share <= 1.0 else mix(_MIDDLE, _FAST, share - 1.0)


def speed_tint(speed_mps: float) -> Colour:
    """Blue of a vehicle at this speed: dark at 0, pale at :data:`FAST_MPS` and above."""
    return _tint(round(min(max(speed_mps / FAST_MPS, 0.0), 1.0) * _TINTS))


def readable_on(colour: Colour) -> Colour:
    """Black or white, whichever reads better on ``colour``."""
    luminance = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
    return (16, 18, 22) if luminance > 130 else (255, 255, 255)


#: Pillow's own letters at a size in pixels: no font has to be installed.
_font = lru_cache(maxsize=16)(ImageFont.load_default)


@lru_cache(maxsize=4096)
def text_mask(text: str, size: int) -> Image.Image:
    """The text as a coverage mask (mode L), cut to its ink across and to the line height upwards."""
    letters = _font(size)
    left, _, right, _ = letters.getbbox(text)
    mask = Image.new("L", (max(1, round(right - left) + 1), round(size * 1.25)))
    ImageDraw.Draw(mask).text((-left, 0), text, fill=255, font=letters)
    return mask


def put_text(
    image: Image.Image,
    position: tuple[float, float],
    text: str,
    size: int,
    colour: Colour,
    anchor: float = 0.0,
) -> None:
    """Write ``text`` with its top at ``position``.

    ``anchor`` 0 starts there, 0.5 centres, 1 ends there.
    """
    if text:
        mask = text_mask(text, size)
        image.paste(colour, (round(position[0] - anchor * mask.width), round(position[1])), mask)


@dataclass(frozen=True)
class WindowParameters:
    """Size of the picture in pixels and how much road it shows.

    Across the road the scale is up to ``lateral_exaggeration`` times that along it (less where many
    lanes need the room): vehicles and lateral movements look wider than they are, overlaps stay
    overlaps.
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


class Window:
    """The scale of a picture for a road of ``lanes`` lanes; rows of the picture count downwards.

    Attributes:
        along, across: pixels per metre along and across the road; across it is exaggerated, but
            never more than the picture has room for.
        edges: rows of the left (upper) and right (lower) edge of the road.
    """

    def __init__(self, parameters: WindowParameters, lanes: int, lane_width_m: float) -> None:
        self.parameters, self.lanes, self.lane_width_m = parameters, lanes, lane_width_m
        self._room = parameters.height - HEADER_HEIGHT - FOOTER_HEIGHT
        self.along = parameters.width / parameters.length_m
        wanted = self.along * parameters.lateral_exaggeration
        self.across = min(wanted, self._room / (lanes * lane_width_m + 2.0))
        upper, lower = self.row([(lanes - 0.5) * lane_width_m, -0.5 * lane_width_m])
        self.edges = float(upper), float(lower)

    def row(self, y_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Picture rows of lateral positions, m."""
        centre = 0.5 * (self.lanes - 1) * self.lane_width_m
        return (
            HEADER_HEIGHT
            + self._room / 2
            - (np.asarray(y_m, dtype=np.float64) - centre) * self.across
        )

    def column(self, x_m: npt.ArrayLike, ego_x_m: float) -> npt.NDArray[np.float64]:
        """Picture columns of positions along the road, m, with the ego at ``ego_x_m``."""
        start = ego_x_m - self.parameters.behind * self.parameters.length_m
        return (np.asarray(x_m, dtype=np.float64) - start) * self.along


class Backdrop:
    """Verges, asphalt, edge lines and dashed lane marks.

    Drawn once, one period wider than the picture.
    """

    def __init__(self, window: Window):
        self.window = window
        self.period = round(2 * PERIOD_M * window.along)
        size = window.parameters
        self.strip = strip = Image.new("RGB", (size.width + self.period, size.height), VERGE)
        draw = ImageDraw.Draw(strip)
        half = self.period / 2
        upper, lower = window.edges
        starts = np.arange(0, strip.width, half)
        # every second period's verge is a shade lighter so that movement shows
        for start in starts[::2]:
            draw.rectangle((start, 0, start + half - 1, size.height), fill=VERGE_STRIPE)
        draw.rectangle((0, upper - 5, strip.width, lower + 5), fill=ASPHALT)
        for edge in (upper, lower):
            draw.line((0, edge, strip.width, edge), fill=MARK, width=3)
        for mark in window.row((np.arange(window.lanes - 1) + 0.5) * window.lane_width_m):
            for start in starts:
                draw.line((start, mark, start + DASH_M * window.along, mark), fill=MARK, width=2)

    def at(self, ego_x_m: float) -> Image.Image:
        """A fresh picture of the road around the ego, with posts that tell the distance from the
        start, m.
        """
        shift = round(-float(self.window.column(0.0, ego_x_m))) % self.period
        size, (_, lower) = self.window.parameters, self.window.edges
        picture = self.strip.crop((shift, 0, shift + size.width, size.height))
        start = ego_x_m - size.behind * size.length_m
        first = np.ceil((start - 10.0) / POST_EVERY_M) * POST_EVERY_M
        posts = np.arange(first, start + size.length_m + 10.0, POST_EVERY_M)
        draw = ImageDraw.Draw(picture)
        for metres, column in zip(posts, self.window.column(posts, ego_x_m)):
            draw.line((column, lower + 7, column, lower + 20), fill=FAINT, width=2)
            put_text(picture, (column + 7, lower + 8), f"{int(metres)} m", 12, FAINT)
        return picture
