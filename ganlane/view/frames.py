"""Frames of a recorded episode, drawn with Pillow alone: no display is needed.

A top view that follows the ego (orange); the others are blue, the faster the paler. White trails show where
vehicles came from, numbers on the roofs are speeds in m/s. Overlapping vehicles have a red edge. The scale
across the road is larger than along it (:class:`~ganlane.view.window.WindowParameters`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.view import style
from ganlane.view.backdrop import Backdrop
from ganlane.view.bodies import Body, draw_body
from ganlane.view.header import Header
from ganlane.view.trails import draw_trails
from ganlane.view.trajectory import Trajectory
from ganlane.view.window import HEADER_HEIGHT, Window, WindowParameters

Picture = npt.NDArray[np.uint8]
#: Braking harder than this lights the brake lights, m/s2.
_BRAKE_LIGHT = -0.8
#: A vehicle this far from its target lane's centre signals, m.
_SIGNAL_M = 0.4
_BLINK_S = 0.6


@dataclass(frozen=True)
class DrawingParameters:
    """What is drawn besides the road and the vehicles."""

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
        self._header = Header(trajectory, self.window.parameters.width)
        self._overlapping = trajectory.overlapping()
        self._jumped = trajectory.jumped()

    def draw(self, frame: int) -> Picture:
        """The picture of one frame, [height, width, 3]."""
        ego_x = float(self.trajectory.x[frame, 0])
        picture = self._backdrop.at(ego_x)
        self._draw_trails(picture, frame, ego_x)
        shown = self._shown(frame, ego_x)
        if self.drawing.leader_line:
            self._draw_leader_line(picture, frame, ego_x)
        for vehicle in shown[::-1]:  # the ego comes last, on top of the others
            draw_body(picture, self._body(frame, vehicle, ego_x), self.window, self.drawing.speeds)
        self._draw_counts(picture, frame, ego_x)
        self._header.draw(picture, frame)
        return np.asarray(picture)

    def _shown(self, frame: int, ego_x: float) -> list[int]:
        """Vehicles that reach into the picture, in their order."""
        trajectory, size = self.trajectory, self.window.parameters
        columns, reach = self.window.column(trajectory.x[frame], ego_x), trajectory.length[frame] * self.window.along
        inside = (columns > -reach) & (columns < size.width + reach) & trajectory.valid[frame]
        return np.flatnonzero(inside).tolist()

    def _body(self, frame: int, vehicle: int, ego_x: float) -> Body:
        """A vehicle of a frame, ready to be drawn."""
        t = self.trajectory
        speed = float(t.speed[frame, vehicle])
        return Body(
            column=float(self.window.column(t.x[frame, vehicle], ego_x)),
            row=float(self.window.row(t.y[frame, vehicle])),
            heading=float(t.heading[frame, vehicle]),
            length_m=float(t.length[frame, vehicle]),
            width_m=float(t.width[frame, vehicle]),
            speed_mps=speed,
            colour=style.EGO if vehicle == 0 else style.speed_tint(speed),
            braking=bool(t.acceleration[frame, vehicle] < _BRAKE_LIGHT),
            signal=self._signal(frame, vehicle),
            overlaps=bool(self._overlapping[frame, vehicle]),
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

    def _draw_leader_line(self, picture: Image.Image, frame: int, ego_x: float) -> None:
        """A line from the ego's front to the rear of the nearest vehicle ahead in its lane, with the gap."""
        t, lane = self.trajectory, self.trajectory.lane()[frame]
        ahead = t.valid[frame] & (lane == lane[0]) & (t.x[frame] > t.x[frame, 0])
        if not ahead.any():
            return
        leader = int(np.where(ahead, t.x[frame], np.inf).argmin())
        front = t.x[frame, 0] + t.length[frame, 0] / 2
        rear = t.x[frame, leader] - t.length[frame, leader] / 2
        start, end = self.window.column([front, rear], ego_x)
        row = float(self.window.row(t.y[frame, 0]))
        ImageDraw.Draw(picture).line((start, row, end, row), fill=style.LEADER, width=1)
        text_at = ((start + min(end, self.window.parameters.width)) / 2, row - 17)
        style.put_text(picture, text_at, f"{rear - front:.0f} m", 12, style.LEADER, 0.5)

    def _draw_counts(self, picture: Image.Image, frame: int, ego_x: float) -> None:
        """How many vehicles are behind and ahead of the picture."""
        columns, size = self.window.column(self.trajectory.x[frame], ego_x), self.window.parameters
        valid = self.trajectory.valid[frame]
        behind, ahead = int((valid & (columns < 0)).sum()), int((valid & (columns > size.width)).sum())
        top = HEADER_HEIGHT + 6
        style.put_text(picture, (12, top), f"{behind} behind" if behind else "", 12, style.FAINT)
        style.put_text(picture, (size.width - 12, top), f"{ahead} ahead" if ahead else "", 12, style.FAINT, 1.0)


class Film(Sequence[Picture]):
    """The frames of a film, each drawn when it is asked for, so that long films need no memory.

    Args:
        painter: draws the frames.
        fps: frames per second of the film.
        speedup: simulated seconds per second of film.
        start_s, end_s: part of the episode, s; None for its end.
        hold_s: how long the last frame stays, s of film.
    """

    def __init__(
        self,
        painter: FramePainter,
        fps: float = 20.0,
        speedup: float = 1.0,
        start_s: float = 0.0,
        end_s: float | None = None,
        hold_s: float = 1.5,
    ):
        self.painter, self.fps = painter, fps
        time = painter.trajectory.time_s
        end = float(time[-1]) if end_s is None else min(end_s, float(time[-1]))
        wanted = np.arange(start_s, end + 1e-9, speedup / fps)
        # The nearest frame of the trajectory; the last one always belongs to the film.
        nearest = np.searchsorted(time, wanted + painter.trajectory.frame_s / 2, side="right") - 1
        last = int(np.searchsorted(time, end + 1e-9, side="right") - 1)
        self._frames: list[int] = [*nearest.clip(0, last).tolist(), *[last] * max(1, round(hold_s * fps))]

    def __len__(self) -> int:
        """Number of frames of the film."""
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> Picture: ...
    @overload
    def __getitem__(self, index: slice) -> list[Picture]: ...
    def __getitem__(self, index: int | slice) -> Picture | list[Picture]:
        """Draw one frame, or a list of them."""
        if isinstance(index, slice):
            return [self.painter.draw(frame) for frame in self._frames[index]]
        return self.painter.draw(self._frames[index])

    def __iter__(self) -> Iterator[Picture]:
        """Draw all frames, one after the other."""
        return (self.painter.draw(frame) for frame in self._frames)
