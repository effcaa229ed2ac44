"""The line above the picture: who drives where, and how it stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from ganlane.view import style
from ganlane.view.trajectory import ACTION_NAMES, Trajectory
from ganlane.view.window import HEADER_HEIGHT

#: Titles and widths in pixels of the values, for a picture 1280 pixels wide.
_VALUES = (("time", 90), ("speed", 100), ("return", 90), ("action", 80))
#: The largest that leaves room for the values, pixels.
_TITLE_SIZES = (20, 17, 14, 12)
#: In a narrower picture the scale of the tints is left out.
_WIDTH_FOR_TINTS = 1000
_OUTCOMES = {
    "goal": ("GOAL", style.GOOD),
    "hard_crash": ("HARD CRASH", style.CRASH),
    "out_of_road": ("OUT OF ROAD", style.CRASH),
    "timeout": ("TIME-OUT", style.AMBER),
    "scene_end": ("END OF RECORDING", style.AMBER),
}


@dataclass
class Header:
    """Draws the header of a trajectory's frames; what never changes is drawn once."""

    trajectory: Trajectory
    width: int

    def __post_init__(self) -> None:
        self._has_tints = self.width >= _WIDTH_FOR_TINTS
        values = sum(width for _, width in _VALUES)
        self._columns = self.width - values - (340 if self._has_tints else 10)
        self._still = self._draw_still()

    def _draw_still(self) -> Image.Image:
        """Names, titles of the values and the scale of the tints."""
        still = Image.new("RGB", (self.width, HEADER_HEIGHT), style.HEADER)
        label = self.trajectory.label
        lanes = f"{label.lanes} lane" + ("s" if label.lanes > 1 else "")
        title = f"{label.agent}  on  {label.traffic}"
        fitting = (size for size in _TITLE_SIZES if style.text_mask(title, size).width < self._columns - 24)
        style.put_text(still, (16, 8), title, next(fitting, _TITLE_SIZES[-1]), style.TEXT)
        style.put_text(still, (16, 34), f"episode {label.episode}, seed {label.seed}, {lanes}", 12, style.FAINT)
        column = self._columns
        for title, width in _VALUES:
            style.put_text(still, (column, 9), title, 12, style.FAINT)
            column += width
        if self._has_tints:
            self._draw_tints(still)
        return still

    def _draw_tints(self, still: Image.Image) -> None:
        """The scale of the others' tints at the right."""
        left, right = self.width - 170, self.width - 20
        draw = ImageDraw.Draw(still)
        for column in range(left, right):
            speed = (column - left) / (right - left) * style.FAST_MPS
            draw.line((column, 26, column, 35), fill=style.speed_tint(speed))
        style.put_text(still, (left, 9), "others' speed, m/s", 12, style.FAINT)
        for speed in (0, 10, 20, 30):
            at = left + speed / style.FAST_MPS * (right - left)
            style.put_text(still, (at, 38), f"{speed}", 11, style.FAINT, 0.0 if speed == 0 else 0.5)

    def draw(self, picture: Image.Image, frame: int) -> None:
        """Put the header of one frame on the picture, and the outcome on the last frame."""
        trajectory = self.trajectory
        picture.paste(self._still, (0, 0))
        action = int(trajectory.action[frame])
        values = (
            f"{trajectory.time_s[frame]:.1f} s",
            f"{trajectory.speed[frame, 0]:.1f} m/s",
            f"{trajectory.returns[frame]:.1f}",
            ACTION_NAMES[action] if 0 <= action < len(ACTION_NAMES) else "-",
        )
        column = self._columns
        for value, (_, width) in zip(values, _VALUES):
            style.put_text(picture, (column, 25), value, 18, style.EGO if value in ("left", "right") else style.TEXT)
            column += width
        if frame == len(trajectory) - 1 and trajectory.outcome in _OUTCOMES:
            self._stamp(picture, *_OUTCOMES[trajectory.outcome])

    def _stamp(self, picture: Image.Image, text: str, colour: style.Colour) -> None:
        """The outcome, on a plate in the middle below the header."""
        width = int(np.ceil(style.text_mask(text, 24).width)) + 40
        left = (self.width - width) // 2
        draw = ImageDraw.Draw(picture)
        box = (left, HEADER_HEIGHT + 6, left + width, HEADER_HEIGHT + 44)
        draw.rounded_rectangle(box, 8, fill=style.HEADER, outline=colour, width=2)
        style.put_text(picture, (self.width / 2, HEADER_HEIGHT + 11), text, 24, colour, 0.5)
