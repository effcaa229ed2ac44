"""What is written onto a frame: the gap to the leader, who is out of the picture, where it crashed."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from ganlane.view import style
from ganlane.view.trajectory import Trajectory
from ganlane.view.window import HEADER_HEIGHT, Window

_SMALL = 12


def draw_leader_line(picture: Image.Image, window: Window, trajectory: Trajectory, frame: int) -> None:
    """A line from the ego's front to the rear of the nearest vehicle ahead in its lane, with the net gap in m."""
    t, lane = trajectory, trajectory.lane()[frame]
    ahead = t.valid[frame] & (lane == lane[0]) & (t.x[frame] > t.x[frame, 0])
    if not ahead.any():
        return
    leader = int(np.where(ahead, t.x[frame], np.inf).argmin())
    front = t.x[frame, 0] + t.length[frame, 0] / 2
    rear = t.x[frame, leader] - t.length[frame, leader] / 2
    start, end = window.column([front, rear], t.x[frame, 0])
    row = float(window.row(t.y[frame, 0]))
    ImageDraw.Draw(picture).line((start, row, end, row), fill=style.LEADER, width=1)
    middle = (start + min(end, window.parameters.width)) / 2
    style.put_text(picture, (middle, row - 17), f"{rear - front:.0f} m", _SMALL, style.LEADER, 0.5)


def draw_counts(picture: Image.Image, window: Window, trajectory: Trajectory, frame: int) -> None:
    """How many vehicles are behind and ahead of the picture."""
    columns = window.column(trajectory.x[frame], trajectory.x[frame, 0])
    width, valid = window.parameters.width, trajectory.valid[frame]
    room_above = window.edges[0] - HEADER_HEIGHT > 2 * _SMALL
    top = HEADER_HEIGHT + 6 if room_above else window.parameters.height - _SMALL - 6
    behind, ahead = int((valid & (columns < 0)).sum()), int((valid & (columns > width)).sum())
    style.put_text(picture, (12, top), f"{behind} behind" if behind else "", _SMALL, style.FAINT)
    style.put_text(picture, (width - 12, top), f"{ahead} ahead" if ahead else "", _SMALL, style.FAINT, 1.0)


def draw_crash(picture: Image.Image, window: Window, trajectory: Trajectory, frame: int) -> None:
    """A red ring around the ego on the last frame of an episode that ended with a hard crash."""
    if trajectory.outcome != "hard_crash" or frame != len(trajectory) - 1:
        return
    ego_x = trajectory.x[frame, 0]
    column, row = float(window.column(ego_x, ego_x)), float(window.row(trajectory.y[frame, 0]))
    reach = 6.0 * window.along
    ring = (column - reach, row - reach, column + reach, row + reach)
    ImageDraw.Draw(picture).ellipse(ring, outline=style.CRASH, width=3)
