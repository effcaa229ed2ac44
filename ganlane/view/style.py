"""Colours and letters of the frames."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

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

#: Blue for the other vehicles, from standing to ``FAST_MPS``.
_SLOW, _MIDDLE, _FAST = (38, 52, 128), (58, 122, 224), (158, 226, 255)
FAST_MPS = 35.0
TINTS = 36


def mix(first: Colour, second: Colour, share: float) -> Colour:
    """``first`` with ``share`` (0 to 1) of ``second``."""
    a, b = np.array(first), np.array(second)
    red, green, blue = np.rint(a + (b - a) * share).astype(int).tolist()
    return red, green, blue


@lru_cache(maxsize=TINTS + 1)
def _tint(level: int) -> Colour:
    """Blue of one of the :data:`TINTS` + 1 levels."""
    share = 2.0 * level / TINTS
    return mix(_SLOW, _MIDDLE, share) if share <= 1.0 else mix(_MIDDLE, _FAST, share - 1.0)


def speed_tint(speed_mps: float) -> Colour:
    """Blue of a vehicle at this speed: dark at 0, pale at :data:`FAST_MPS` and above."""
    return _tint(round(min(max(speed_mps / FAST_MPS, 0.0), 1.0) * TINTS))


def readable_on(colour: Colour) -> Colour:
    """Black or white, whichever reads better on ``colour``."""
    luminance = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
    return (16, 18, 22) if luminance > 130 else (255, 255, 255)


@lru_cache(maxsize=16)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own letters at this size in pixels: no font has to be installed."""
    return ImageFont.load_default(size)


@lru_cache(maxsize=4096)
def text_mask(text: str, size: int) -> Image.Image:
    """The text as a coverage mask (mode L), cut to its ink across and to the line height upwards."""
    letters = _font(size)
    left, _, right, _ = letters.getbbox(text)
    mask = Image.new("L", (max(1, round(right - left) + 1), round(size * 1.25)))
    ImageDraw.Draw(mask).text((-left, 0), text, fill=255, font=letters)
    return mask


def put_text(
    image: Image.Image, position: tuple[float, float], text: str, size: int, colour: Colour, anchor: float = 0.0
) -> None:
    """Write ``text`` with its top at ``position``; ``anchor`` 0 starts there, 0.5 centres, 1 ends there."""
    if text:
        mask = text_mask(text, size)
        image.paste(colour, (round(position[0] - anchor * mask.width), round(position[1])), mask)
