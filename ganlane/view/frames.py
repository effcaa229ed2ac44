"""Frames of a recorded episode, drawn with Pillow alone: no display is needed.

A top view that follows the ego (orange, pointed, with a white edge); the others are blue, the
faster the paler, with glass, indicators and brake lights. White trails show where vehicles came
from, numbers on the roofs are speeds in m/s. Overlapping vehicles have a red edge. The scale across
the road is larger than along it (:class:`~ganlane.view.canvas.WindowParameters`), as the header
says.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.view import canvas
from ganlane.view.canvas import HEADER_HEIGHT, Backdrop, Window, WindowParameters
from ganlane.view.record import ACTION_NAMES, Trajectory

FloatArray = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

#: Braking harder than this lights the brake lights, m/s2.
_BRAKE_LIGHT = -0.8
#: A vehicle this far from its target lane's centre signals, m.
_SIGNAL_M = 0.4
_BLINK_S = 0.6
_SMALL = 12
#: Bodies and trails are drawn so many times larger and reduced, which smooths their edges.
_BODY_OVERSAMPLING, _TRAIL_OVERSAMPLING = 3, 2
#: Pixels around a trail that its width may reach into.
_TRAIL_MARGIN = 3
#: Coverage (0 to 255) of the oldest, middle and newest third of a trail, the ego's and the others'.
_EGO_COVERAGE, _OTHER_COVERAGE = (110, 175, 240), (45, 80, 120)

#: Outlines as shares of length (to the front) and width (to the left).
_BODY = np.array(
    [
        (-0.5, 0.42),
        (-0.46, 0.5),
        (0.38, 0.5),
        (0.5, 0.34),
        (0.5, -0.34),
        (0.38, -0.5),
        (-0.46, -0.5),
        (-0.5, -0.42),
    ]
)
_EGO = np.array([(-0.5, 0.5), (0.2, 0.5), (0.5, 0.08), (0.5, -0.08), (0.2, -0.5), (-0.5, -0.5)])
_GLASS = (
    np.array([(0.14, 0.42), (0.27, 0.34), (0.27, -0.34), (0.14, -0.42)]),
    np.array([(-0.38, 0.36), (-0.31, 0.40), (-0.31, -0.40), (-0.38, -0.36)]),
)
_BRAKES = (
    np.array([(-0.5, 0.42), (-0.44, 0.42), (-0.44, 0.2), (-0.5, 0.2)]),
    np.array([(-0.5, -0.42), (-0.44, -0.42), (-0.44, -0.2), (-0.5, -0.2)]),
)
_INDICATORS_LEFT = (
    np.array([(0.32, 0.5), (0.38, 0.5), (0.5, 0.34), (0.5, 0.2), (0.40, 0.26)]),
    np.array([(-0.46, 0.5), (-0.36, 0.5), (-0.40, 0.28), (-0.5, 0.24), (-0.5, 0.42)]),
)

#: Titles and widths in pixels of the header's values.
_VALUES = (("time", 90), ("speed", 100), ("return", 90), ("action", 80))
#: Sizes of the title; the largest that leaves room for the values is taken, pixels.
_TITLE_SIZES = (20, 17, 14, 12)
#: A narrower picture has no scale of the tints.
_WIDTH_FOR_TINTS = 1000
_OUTCOMES = {
    "goal": ("GOAL", canvas.GOOD),
    "hard_crash": ("HARD CRASH", canvas.CRASH),
    "out_of_road": ("OUT OF ROAD", canvas.CRASH),
    "timeout": ("TIME-OUT", canvas.AMBER),
    "scene_end": ("END OF RECORDING", canvas.AMBER),
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
        # the ego comes last, on top of the others
        for vehicle in np.flatnonzero(in_picture)[::-1].tolist():
            self._draw_vehicle(picture, frame, vehicle, float(columns[vehicle]))
        if t.outcome == "hard_crash" and frame == len(t) - 1:
            column, row, radius = (
                float(columns[0]),
                float(self.window.row(t.y[frame, 0])),
                6.0 * self.window.along,
            )
            ring = (column - radius, row - radius, column + radius, row + radius)
            ImageDraw.Draw(picture).ellipse(ring, outline=canvas.CRASH, width=3)
        # How many vehicles are behind and ahead of the picture.
        room_above = self.window.edges[0] - HEADER_HEIGHT > 2 * _SMALL
        top = HEADER_HEIGHT + 6 if room_above else size.height - _SMALL - 6
        behind, ahead = (
            int((t.valid[frame] & out).sum()) for out in (columns < 0, columns > size.width)
        )
        canvas.put_text(
            picture, (12, top), f"{behind} behind" if behind else "", _SMALL, canvas.FAINT
        )
        canvas.put_text(
            picture,
            (size.width - 12, top),
            f"{ahead} ahead" if ahead else "",
            _SMALL,
            canvas.FAINT,
            1.0,
        )
        self._header.draw(picture, frame)
        return np.asarray(picture)

    def _draw_vehicle(self, picture: Image.Image, frame: int, vehicle: int, column: float) -> None:
        """A box to scale, its centre in this column, with its speed in m/s on the roof."""
        t, at, window, is_ego = self.trajectory, (frame, vehicle), self.window, vehicle == 0
        middle = np.array([column, float(window.row(t.y[at]))])
        # Pixels (column, row) per share of length and of width.
        cos, sin = np.cos(t.heading[at]), np.sin(t.heading[at])
        forward = np.array([cos * window.along, -sin * window.across]) * t.length[at]
        left = np.array([-sin * window.along, -cos * window.across]) * t.width[at]
        reach = np.ceil((np.abs(forward) + np.abs(left)) / 2 + 3).astype(int)
        origin = np.floor(middle).astype(int) - reach
        centre = (middle - origin) * _BODY_OVERSAMPLING

        def outline(shares: FloatArray) -> list[tuple[float, float]]:
            points = centre + _BODY_OVERSAMPLING * (shares[:, :1] * forward + shares[:, 1:] * left)
            return [(x, y) for x, y in points.tolist()]

        colour = canvas.EGO if is_ego else canvas.speed_tint(float(t.speed[at]))
        edge = canvas.TEXT if is_ego else canvas.mix(colour, (0, 0, 0), 0.65)
        overlaps, signal = bool(self._overlapping[at]), self._signal(frame, vehicle)
        edge = canvas.CRASH if overlaps else edge
        width, height = ((2 * reach + 1) * _BODY_OVERSAMPLING).tolist()
        patch = Image.new("RGBA", (width, height), (*edge, 0))
        draw, body = ImageDraw.Draw(patch), _EGO if is_ego else _BODY
        draw.polygon(outline(body), fill=(*edge, 255))
        draw.polygon(outline(body * (0.86 if overlaps or is_ego else 0.93)), fill=(*colour, 255))
        for glass in _GLASS[1:] if is_ego else _GLASS:
            draw.polygon(outline(glass), fill=(*canvas.GLASS, 255))
        for light in _BRAKES if t.acceleration[at] < _BRAKE_LIGHT else ():
            draw.polygon(outline(light), fill=(*canvas.BRAKE, 255))
        for light in _INDICATORS_LEFT if signal else ():
            draw.polygon(outline(light * (1.0, signal)), fill=(*canvas.AMBER, 255))
        smooth = patch.reduce(_BODY_OVERSAMPLING)
        picture.paste(smooth, (int(origin[0]), int(origin[1])), smooth)
        if self.drawing.speeds:
            place = (column - 0.09 * forward[0], middle[1] - _SMALL * 0.62)
            canvas.put_text(
                picture, place, f"{t.speed[at]:.0f}", _SMALL, canvas.readable_on(colour), 0.5
            )

    def _signal(self, frame: int, vehicle: int) -> int:
        """Side to which the vehicle's indicator is lit now, +1 for the left, or 0; it blinks."""
        t = self.trajectory
        offset = float(t.target_lane[frame, vehicle] * t.label.lane_width_m - t.y[frame, vehicle])
        lit = t.time_s[frame] % _BLINK_S < 0.6 * _BLINK_S
        return int(np.sign(offset)) if lit and abs(offset) > _SIGNAL_M else 0

    def _draw_trails(self, picture: Image.Image, frame: int, ego_x: float) -> None:
        """Trails over the last seconds, as in the paper's Figure 3.

        The ego's brighter, older parts fainter.
        """
        steps = round(self.drawing.trail_s / self.trajectory.frame_s)
        if steps < 1 or frame == 0:
            return
        t, past = self.trajectory, slice(max(0, frame - steps), frame + 1)
        # What came before a jump belongs to another place.
        jumps_to_come: npt.NDArray[np.int64] = (
            np.cumsum(self._jumped[past][::-1], axis=0)[::-1] - self._jumped[past]
        )
        known = t.valid[past] & t.valid[frame] & (jumps_to_come == 0)
        places = np.stack(
            (self.window.column(t.x[past], ego_x), self.window.row(t.y[past])), axis=-1
        )
        for vehicle in range(t.vehicles - 1, -1, -1):
            trail = places[:, vehicle][known[:, vehicle]]
            if len(trail) > 1:
                self._draw_trail(picture, trail, _OTHER_COVERAGE if vehicle else _EGO_COVERAGE)

    def _draw_trail(
        self, picture: Image.Image, trail: FloatArray, coverage: tuple[int, int, int]
    ) -> None:
        """Places [S, 2], oldest first, as three lines that share their ends, on a mask no larger
        than they are.

        What is outside the road and a margin is cut off.
        """
        upper, lower = self.window.edges
        (left, top), (right, bottom) = trail.min(axis=0).astype(int), trail.max(axis=0).astype(int)
        left, right = max(0, left - _TRAIL_MARGIN), min(picture.width, right + _TRAIL_MARGIN)
        top, bottom = (
            max(int(upper) - 20, top - _TRAIL_MARGIN),
            min(int(lower) + 20, bottom + _TRAIL_MARGIN),
        )
        if left >= right or top >= bottom:
            return
        mask = Image.new(
            "L", ((right - left) * _TRAIL_OVERSAMPLING, (bottom - top) * _TRAIL_OVERSAMPLING)
        )
        draw, points = ImageDraw.Draw(mask), (trail - (left, top)) * _TRAIL_OVERSAMPLING
        cuts = np.linspace(0, len(points) - 1, 4).astype(int)
        parts = [points[start : end + 1] for start, end in pairwise(cuts) if end > start]
        for part, strength in zip(parts, coverage):
            draw.line(
                [(x, y) for x, y in part.tolist()], fill=strength, width=2 * _TRAIL_OVERSAMPLING
            )
        picture.paste((255, 255, 255), (left, top), mask.reduce(_TRAIL_OVERSAMPLING))

    def _draw_leader_line(self, picture: Image.Image, frame: int) -> None:
        """A line from the ego's front to the rear of the nearest vehicle ahead in its lane, with
        the net gap in m.
        """
        t, lane = self.trajectory, self.trajectory.lane()[frame]
        ahead = t.valid[frame] & (lane == lane[0]) & (t.x[frame] > t.x[frame, 0])
        if not ahead.any():
            return
        leader = int(np.where(ahead, t.x[frame], np.inf).argmin())
        front = t.x[frame, 0] + t.length[frame, 0] / 2
        rear = t.x[frame, leader] - t.length[frame, leader] / 2
        start, end = self.window.column([front, rear], t.x[frame, 0])
        row = float(self.window.row(t.y[frame, 0]))
        ImageDraw.Draw(picture).line((start, row, end, row), fill=canvas.LEADER, width=1)
        middle = (start + min(end, self.window.parameters.width)) / 2
        canvas.put_text(
            picture, (middle, row - 17), f"{rear - front:.0f} m", _SMALL, canvas.LEADER, 0.5
        )


class _Header:
    """The line above the picture.

    Driver, traffic, episode, and the frame's time, speed, return and action.
    """

    def __init__(self, trajectory: Trajectory, window: Window) -> None:
        self.trajectory, self.width = trajectory, window.parameters.width
        has_tints = self.width >= _WIDTH_FOR_TINTS
        self._columns = self.width - sum(width for _, width in _VALUES) - (340 if has_tints else 10)
        self._fixed = fixed = Image.new("RGB", (self.width, HEADER_HEIGHT), canvas.HEADER)
        label = trajectory.label
        title = f"{label.agent}  on  {label.traffic}"
        fitting = (
            size
            for size in _TITLE_SIZES
            if canvas.text_mask(title, size).width < self._columns - 24
        )
        canvas.put_text(fixed, (16, 8), title, next(fitting, _TITLE_SIZES[-1]), canvas.TEXT)
        facts = f"episode {label.episode}, seed {label.seed}, {label.lanes} lane{'s' if label.lanes > 1 else ''}"
        if (factor := window.across / window.along) > 1.05:
            facts += f"; drawn {factor:.1f} times as wide as it is"
        canvas.put_text(fixed, (16, 34), facts, _SMALL, canvas.FAINT)
        column = self._columns
        for title, width in _VALUES:
            canvas.put_text(fixed, (column, 9), title, _SMALL, canvas.FAINT)
            column += width
        if has_tints:
            self._draw_tints()

    def _draw_tints(self) -> None:
        """The scale of the others' tints at the right."""
        left, right = self.width - 170, self.width - 20
        draw = ImageDraw.Draw(self._fixed)
        for column in range(left, right):
            speed = (column - left) / (right - left) * canvas.FAST_MPS
            draw.line((column, 26, column, 35), fill=canvas.speed_tint(speed))
        canvas.put_text(self._fixed, (left, 9), "others' speed, m/s", _SMALL, canvas.FAINT)
        for speed in (0, 10, 20, 30):
            at = left + speed / canvas.FAST_MPS * (right - left)
            canvas.put_text(
                self._fixed, (at, 38), f"{speed}", 11, canvas.FAINT, 0.0 if speed == 0 else 0.5
            )

    def draw(self, picture: Image.Image, frame: int) -> None:
        """Put the header of one frame on the picture, and the outcome on the last frame."""
        t, action = self.trajectory, int(self.trajectory.action[frame])
        picture.paste(self._fixed, (0, 0))
        values = (
            f"{t.time_s[frame]:.1f} s",
            f"{t.speed[frame, 0]:.1f} m/s",
            f"{t.returns[frame]:.1f}",
            ACTION_NAMES[action] if 0 <= action < len(ACTION_NAMES) else "-",
        )
        column = self._columns
        for value, (_, width) in zip(values, _VALUES):
            colour = canvas.EGO if value in ("left", "right") else canvas.TEXT
            canvas.put_text(picture, (column, 25), value, 18, colour)
            column += width
        if frame < len(t) - 1 or t.outcome not in _OUTCOMES:
            return
        # The outcome, on a plate in the middle below the header.
        text, colour = _OUTCOMES[t.outcome]
        width = int(np.ceil(canvas.text_mask(text, 24).width)) + 40
        left = (self.width - width) // 2
        box = (left, HEADER_HEIGHT + 6, left + width, HEADER_HEIGHT + 44)
        ImageDraw.Draw(picture).rounded_rectangle(
            box, 8, fill=canvas.HEADER, outline=colour, width=2
        )
        canvas.put_text(picture, (self.width / 2, HEADER_HEIGHT + 11), text, 24, colour, 0.5)
