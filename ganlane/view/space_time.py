"""Positions over time: how recorded vehicles of a lane went on, and how generated ones do from the same start."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl
from PIL import Image, ImageDraw

from ganlane.data import FRAME_S
from ganlane.view.plot import INK, LINES, PAPER, Line, Panel
from ganlane.view.style import Colour, put_text

_WIDTH, _HEIGHT, _LEGEND = 900, 520, 34


def lane_lines(frame: pl.DataFrame, lane: int, colour: Colour) -> list[Line]:
    """Position over time, m and s, of every vehicle of one scene that appears in ``lane``.

    Args:
        frame: one scene in the schema, sorted by track.
        lane: 0 is the rightmost.
        colour: of the lines.
    """
    lines = []
    for track in frame.partition_by("vehicle", maintain_order=True):
        if track["lane"][0] == lane:
            lines.append(Line(track["frame"].to_numpy() * FRAME_S, track["x"].to_numpy(), colour))
    return lines


def draw_space_time(scene: str, lane: int, courses: Mapping[str, pl.DataFrame]) -> Image.Image:
    """All courses of one lane in one plot, the first in the colour of ink and the others over it.

    Args:
        scene: its name.
        lane: whose vehicles are drawn.
        courses: name to trajectories (:func:`ganlane.evaluation.realism.recordings.frame_of`) of the same scene.
    """
    colours = dict(zip(courses, (INK, *LINES)))
    lines = [line for name, frame in courses.items() for line in lane_lines(frame, lane, colours[name])]
    kept = [line for line in lines if len(line.x) > 1 and np.isfinite(line.y).all()]
    panel = Panel(f"{scene}, lane {lane}: position, m", kept, _WIDTH, _HEIGHT, "time, s")
    sheet = Image.new("RGB", (_WIDTH, _HEIGHT + _LEGEND), PAPER)
    sheet.paste(panel.draw(), (0, _LEGEND))
    draw, left = ImageDraw.Draw(sheet), 64
    for name, colour in colours.items():
        draw.line((left, 20, left + 22, 20), fill=colour, width=3)
        left += 30 + put_text(sheet, (left + 30, 11), name, 14, INK) + 28
    return sheet
