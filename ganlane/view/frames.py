"""Frames of a recorded episode, drawn with Pillow alone: no display is needed.

A top view that follows the ego (orange, pointed, with a white edge); the others are blue, the faster the paler.
White trails show where vehicles came from, numbers on the roofs are speeds in m/s. Overlapping vehicles have a red
edge. The scale across the road is larger than along it (:class:`~ganlane.view.window.WindowParameters`), as the
header says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.view import style
from ganlane.view.record import ACTION_NAMES, Trajectory
from ganlane.view.vehicles import Body, draw_body, draw_trails
from ganlane.view.window import HEADER_HEIGHT, Backdrop, Window, WindowParameters

Picture = npt.NDArray[np.uint8]
#: Braking harder than this lights the brake lights, m/s2.
_BRAKE_LIGHT = -0.8
#: A vehicle this far from its target lane's centre signals, m.
_SIGNAL_M = 0.4
_BLINK_S = 0.6
_SMALL = 12
#: Titles and widths in pixels of the header's values.
_VALUES = (("time", 90), ("speed", 100), ("return", 90), ("action", 80))
#: Sizes of the title; the largest that leaves room for the values is taken, pixels.
_TITLE_SIZES = (20, 17, 14, 12)
#: A narrower picture has no scale of the tints.
_WIDTH_FOR_TINTS = 1000
_OUTCOMES = {
    "goal": ("GOAL", style.GOOD),
    "hard_crash": ("HARD CRASH", style.CRASH),
    "out_of_road": ("OUT OF ROAD", style.CRASH),
    "timeout": ("TIME-OUT", style.AMBER),
    "scene_end": ("END OF RECORDING", style.AMBER),
}


@dataclass(frozen=True)
class DrawingParameters:
    """What is drawn in addition to the road and the vehicles."""

    #: Length of the trails, s; 0 for none.
    trail_s: float = 3.0
    speeds: bool = True
    #: A line from the ego to its leader, with the net gap in m.
    leader_line: bool = False


class FramePainter:
    """Draws the frames of one trajectory; everything that stays the same is drawn once, here.

    Args:
        trajectory: the recorded episode.
        window: size of the picture and road shown.
        drawing: trails, speeds, leader line.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        window: WindowParameters | None = None,
        drawing: DrawingParameters | None = None,
    ):
        self.trajectory = trajectory
        self.drawing = drawing or DrawingParameters()
        label = trajectory.label
        self.window = Window(window or WindowParameters(), label.lanes, label.lane_width_m)
        self._backdrop = Backdrop(self.window)
        self._header = _Header(trajectory, self.window)
        self._overlapping = trajectory.overlapping()
        self._jumped = trajectory.jumped()

    def draw(self, frame: int) -> Picture:
        """The picture of one frame, [height, width, 3]."""
        t, size = self.trajectory, self.window.parameters
        ego_x = float(t.x[frame, 0])
        columns, reach = self.window.column(t.x[frame], ego_x), t.length[frame] * self.window.along
        picture = self._backdrop.at(ego_x)
        self._draw_trails(picture, frame, ego_x)
        if self.drawing.leader_line:
            self._draw_leader_line(picture, frame)
        in_picture = (columns > -reach) & (columns < size.width + reach) & t.valid[frame]
        for vehicle in np.flatnonzero(in_picture)[::-1].tolist():  # the ego comes last, on top of the others
            draw_body(picture, self._body(frame, vehicle, columns[vehicle]), self.window, self.drawing.speeds)
        if t.outcome == "hard_crash" and frame == len(t) - 1:
            column, row, radius = float(columns[0]), float(self.window.row(t.y[frame, 0])), 6.0 * self.window.along
            ring = (column - radius, row - radius, column + radius, row + radius)
            ImageDraw.Draw(picture).ellipse(ring, outline=style.CRASH, width=3)
        self._draw_counts(picture, columns, t.valid[frame])
        self._header.draw(picture, frame)
        return np.asarray(picture)

    def _body(self, frame: int, vehicle: int, column: float) -> Body:
        """A vehicle of a frame, ready to be drawn."""
        t = self.trajectory
        speed = float(t.speed[frame, vehicle])
        return Body(
            column=float(column),
            row=float(self.window.row(t.y[frame, vehicle])),
            heading=float(t.heading[frame, vehicle]),
            length_m=float(t.length[frame, vehicle]),
            width_m=float(t.width[frame, vehicle]),
            speed_mps=speed,
            colour=style.EGO if vehicle == 0 else style.speed_tint(speed),
            braking=bool(t.acceleration[frame, vehicle] < _BRAKE_LIGHT),
            signal=self._signal(frame, vehicle),
            overlaps=bool(self._overlapping[frame, vehicle]),
            is_ego=vehicle == 0,
        )

    def _signal(self, frame: int, vehicle: int) -> int:
        """Side to which the vehicle's indicator is lit now; it blinks."""
        t = self.trajectory
        offset = float(t.target_lane[frame, vehicle] * t.label.lane_width_m - t.y[frame, vehicle])
        lit = t.time_s[frame] % _BLINK_S < 0.6 * _BLINK_S
        return int(np.sign(offset)) if lit and abs(offset) > _SIGNAL_M else 0

    def _draw_trails(self, picture: Image.Image, frame: int, ego_x: float) -> None:
        """White trails of all vehicles over the last seconds."""
        steps = round(self.drawing.trail_s / self.trajectory.frame_s)
        if steps < 1 or frame == 0:
            return
        t, past = self.trajectory, slice(max(0, frame - steps), frame + 1)
        known = t.valid[past] & t.valid[frame]
        # What came before a jump belongs to another place.
        same_place: npt.NDArray[np.bool_] = (
            np.cumsum(self._jumped[past][::-1], axis=0)[::-1] - self._jumped[past] == 0
        )
        columns, rows = self.window.column(t.x[past], ego_x), self.window.row(t.y[past])
        draw_trails(picture, columns, rows, known & same_place, self.window.edges)

    def _draw_leader_line(self, picture: Image.Image, frame: int) -> None:
        """A line from the ego's front to the rear of the nearest vehicle ahead in its lane, with the net gap in m."""
        t, lane = self.trajectory, self.trajectory.lane()[frame]
        ahead = t.valid[frame] & (lane == lane[0]) & (t.x[frame] > t.x[frame, 0])
        if not ahead.any():
            return
        leader = int(np.where(ahead, t.x[frame], np.inf).argmin())
        front = t.x[frame, 0] + t.length[frame, 0] / 2
        rear = t.x[frame, leader] - t.length[frame, leader] / 2
        start, end = self.window.column([front, rear], t.x[frame, 0])
        row = float(self.window.row(t.y[frame, 0]))
        ImageDraw.Draw(picture).line((start, row, end, row), fill=style.LEADER, width=1)
        middle = (start + min(end, self.window.parameters.width)) / 2
        style.put_text(picture, (middle, row - 17), f"{rear - front:.0f} m", _SMALL, style.LEADER, 0.5)

    def _draw_counts(
        self, picture: Image.Image, columns: npt.NDArray[np.float64], valid: npt.NDArray[np.bool_]
    ) -> None:
        """How many vehicles are behind and ahead of the picture."""
        size = self.window.parameters
        room_above = self.window.edges[0] - HEADER_HEIGHT > 2 * _SMALL
        top = HEADER_HEIGHT + 6 if room_above else size.height - _SMALL - 6
        behind, ahead = int((valid & (columns < 0)).sum()), int((valid & (columns > size.width)).sum())
        style.put_text(picture, (12, top), f"{behind} behind" if behind else "", _SMALL, style.FAINT)
        style.put_text(picture, (size.width - 12, top), f"{ahead} ahead" if ahead else "", _SMALL, style.FAINT, 1.0)


class _Header:
    """The line above the picture: driver, traffic, episode, and the frame's time, speed, return and action."""

    def __init__(self, trajectory: Trajectory, window: Window) -> None:
        self.trajectory, self.width = trajectory, (width := window.parameters.width)
        self._factor = window.across / window.along
        has_tints = width >= _WIDTH_FOR_TINTS
        values = sum(width for _, width in _VALUES)
        self._columns = width - values - (340 if has_tints else 10)
        self._fixed = self._draw_fixed()
        if has_tints:
            self._draw_tints(self._fixed)

    def _draw_fixed(self) -> Image.Image:
        """Names and the titles of the values."""
        fixed = Image.new("RGB", (self.width, HEADER_HEIGHT), style.HEADER)
        label = self.trajectory.label
        lanes = f"{label.lanes} lane" + ("s" if label.lanes > 1 else "")
        title = f"{label.agent}  on  {label.traffic}"
        fitting = (size for size in _TITLE_SIZES if style.text_mask(title, size).width < self._columns - 24)
        style.put_text(fixed, (16, 8), title, next(fitting, _TITLE_SIZES[-1]), style.TEXT)
        facts = f"episode {label.episode}, seed {label.seed}, {lanes}"
        if self._factor > 1.05:
            facts += f"; drawn {self._factor:.1f} times as wide as it is"
        style.put_text(fixed, (16, 34), facts, 12, style.FAINT)
        column = self._columns
        for title, width in _VALUES:
            style.put_text(fixed, (column, 9), title, 12, style.FAINT)
            column += width
        return fixed

    def _draw_tints(self, fixed: Image.Image) -> None:
        """The scale of the others' tints at the right."""
        left, right = self.width - 170, self.width - 20
        draw = ImageDraw.Draw(fixed)
        for column in range(left, right):
            speed = (column - left) / (right - left) * style.FAST_MPS
            draw.line((column, 26, column, 35), fill=style.speed_tint(speed))
        style.put_text(fixed, (left, 9), "others' speed, m/s", 12, style.FAINT)
        for speed in (0, 10, 20, 30):
            at = left + speed / style.FAST_MPS * (right - left)
            style.put_text(fixed, (at, 38), f"{speed}", 11, style.FAINT, 0.0 if speed == 0 else 0.5)

    def draw(self, picture: Image.Image, frame: int) -> None:
        """Put the header of one frame on the picture, and the outcome on the last frame."""
        trajectory = self.trajectory
        picture.paste(self._fixed, (0, 0))
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
        if frame < len(trajectory) - 1 or trajectory.outcome not in _OUTCOMES:
            return
        # The outcome, on a plate in the middle below the header.
        text, colour = _OUTCOMES[trajectory.outcome]
        width = int(np.ceil(style.text_mask(text, 24).width)) + 40
        left = (self.width - width) // 2
        box = (left, HEADER_HEIGHT + 6, left + width, HEADER_HEIGHT + 44)
        ImageDraw.Draw(picture).rounded_rectangle(box, 8, fill=style.HEADER, outline=colour, width=2)
        style.put_text(picture, (self.width / 2, HEADER_HEIGHT + 11), text, 24, colour, 0.5)
