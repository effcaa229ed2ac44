"""Frames of a recorded episode, drawn with Pillow alone: no display is needed.

A top view that follows the ego (orange); the others are blue, the faster the paler. White trails show where
vehicles came from, numbers on the roofs are speeds in m/s. Overlapping vehicles have a red edge. The scale
across the road is larger than along it (:class:`~ganlane.view.window.WindowParameters`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

from ganlane.view import style
from ganlane.view.annotations import draw_counts, draw_crash, draw_leader_line
from ganlane.view.backdrop import Backdrop
from ganlane.view.bodies import Body, draw_body
from ganlane.view.header import Header
from ganlane.view.trails import draw_trails
from ganlane.view.trajectory import Trajectory
from ganlane.view.window import Window, WindowParameters

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
            draw_leader_line(picture, self.window, self.trajectory, frame)
        for vehicle in shown[::-1]:  # the ego comes last, on top of the others
            draw_body(picture, self._body(frame, vehicle, ego_x), self.window, self.drawing.speeds)
        draw_crash(picture, self.window, self.trajectory, frame)
        draw_counts(picture, self.window, self.trajectory, frame)
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
