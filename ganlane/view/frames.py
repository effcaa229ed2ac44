"""Frames of a recorded episode, drawn with Pillow alone: no display is needed.

A top view that follows the ego (orange, pointed, with a white edge); the others are blue, the
faster the paler, with indicators and brake lights. White trails show where vehicles came
from, numbers on the roofs are speeds in m/s. Overlapping vehicles have a red edge. The scale across
the road is larger than along it (:data:`ganlane.view.canvas.EXAGGERATION`), as the header says.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.actions import LANE_SPEED, NUMBERED
from ganlane.settings.render import FilmConfig
from ganlane.view import canvas
from ganlane.view.canvas import HEADER_HEIGHT, SMALL, Backdrop, Window, put_text
from ganlane.view.record import EpisodeLabel, FloatArray, Trajectory

Picture = npt.NDArray[np.uint8]

#: Braking harder than this lights the brake lights, m/s2.
_BRAKE_LIGHT = -0.8
#: A vehicle this far from its target lane's centre signals, m.
_SIGNAL_M = 0.4
#: Indicators are lit for the first ``_LIT_S`` of every ``_BLINK_S``.
_BLINK_S, _LIT_S = 0.6, 0.6 * 0.6
#: Bodies and trails are drawn so many times larger and reduced, which smooths their edges.
_BODY_OVERSAMPLING, _TRAIL_OVERSAMPLING = 3, 2
#: Coverage (0 to 255) of the ego's trail and of the others'.
_EGO_COVERAGE, _OTHER_COVERAGE = 200, 90

#: Moves a point, as shares of length and width, from the left side to the right one.
_MIRROR = (1.0, -1.0)


def _symmetric(*left: tuple[float, float]) -> FloatArray:
    """An outline from its left half: shares of length (to the front) and width (to the left)."""
    half = np.array(left)
    return np.concatenate((half, half[::-1] * _MIRROR))


_BODY = _symmetric((-0.5, 0.42), (-0.46, 0.5), (0.38, 0.5), (0.5, 0.34))
_EGO = _symmetric((-0.5, 0.5), (0.2, 0.5), (0.5, 0.08))
# Lights of the left side.
_BRAKE = np.array([(-0.5, 0.42), (-0.44, 0.42), (-0.44, 0.2), (-0.5, 0.2)])
_INDICATORS = (
    np.array([(0.32, 0.5), (0.38, 0.5), (0.5, 0.34), (0.5, 0.2), (0.40, 0.26)]),
    np.array([(-0.46, 0.5), (-0.36, 0.5), (-0.40, 0.28), (-0.5, 0.24), (-0.5, 0.42)]),
)

#: Titles and widths in pixels of the header's values.
_VALUES = {"time": 90, "speed": 100, "return": 90, "action": 80}
#: Size of the title, pixels.
_TITLE = 17
_OUTCOMES = {
    "goal": ("GOAL", canvas.GOOD),
    "hard_crash": ("HARD CRASH", canvas.CRASH),
    "out_of_road": ("OUT OF ROAD", canvas.CRASH),
    "missed_exit": ("EXIT MISSED", canvas.AMBER),
    "timeout": ("TIME-OUT", canvas.AMBER),
    "scene_end": ("END OF RECORDING", canvas.AMBER),
}


class FramePainter:
    """Draws the frames of one trajectory; everything that stays the same is drawn once, here.

    Args:
        trajectory: the recorded episode.
        look: size of the picture, road shown, trails, speeds.
    """

    def __init__(self, trajectory: Trajectory, look: FilmConfig | None = None):
        self.trajectory = trajectory
        self.look = look or FilmConfig()
        label = trajectory.label
        self.window = Window(self.look, label.lanes, label.lane_width_m)
        self._backdrop = Backdrop(self.window, label.stretches)
        self._values_at = self.window.width - sum(_VALUES.values()) - 10
        self._header = _header(label, self.window, self._values_at)
        self._overlapping = trajectory.overlapping()
        # How often a vehicle has jumped so far; trails are cut where this number changes.
        self._jumps = np.cumsum(trajectory.jumped(), axis=0)

    def draw(self, frame: int) -> Picture:
        """The picture of one frame, [height, width, 3]."""
        t, width = self.trajectory, self.window.width
        ego_x = float(t.x[frame, 0])
        columns = self.window.column(t.x[frame], ego_x)
        lengths = t.length[frame] * self.window.along
        picture = self._backdrop.at(ego_x)
        self._draw_trails(picture, frame, ego_x)
        in_picture = (columns > -lengths) & (columns < width + lengths) & t.valid[frame]
        # The ego comes last, on top of the others.
        for vehicle in np.flatnonzero(in_picture)[::-1].tolist():
            self._draw_vehicle(picture, frame, vehicle, float(columns[vehicle]))
        if frame == len(t) - 1:
            self._draw_outcome(picture, float(columns[0]))
        self._draw_header(picture, frame)
        return np.asarray(picture)

    def _draw_vehicle(self, picture: Image.Image, frame: int, vehicle: int, column: float) -> None:
        """A box to scale, its centre in this column, with its speed in m/s on the roof."""
        t, at, window, is_ego = self.trajectory, (frame, vehicle), self.window, vehicle == 0
        middle = np.array([column, float(window.row(t.y[at]))])
        # Pixels (column, row) from end to end and from side to side.
        cos, sin = np.cos(t.heading[at]), np.sin(t.heading[at])
        # Rows of the picture count downwards, so what points to the left has a negative row.
        forward = np.array([cos * window.along, -sin * window.across]) * t.length[at]
        left = np.array([-sin * window.along, -cos * window.across]) * t.width[at]
        # The vehicle is drawn on a patch around its middle.
        reach = np.ceil((np.abs(forward) + np.abs(left)) / 2 + 3).astype(int)
        corner = np.floor(middle).astype(int) - reach
        centre = (middle - corner) * _BODY_OVERSAMPLING
        width, height = ((2 * reach + 1) * _BODY_OVERSAMPLING).tolist()

        overlaps = bool(self._overlapping[at])
        colour = canvas.EGO if is_ego else canvas.speed_tint(float(t.speed[at]))
        edge = canvas.TEXT if is_ego else canvas.darker(colour)
        if overlaps:
            edge = canvas.CRASH
        patch = Image.new("RGBA", (width, height), f"{edge}00")
        draw = ImageDraw.Draw(patch)

        def fill(outline: FloatArray, colour: str) -> None:
            """Fill an outline of shares of length and width."""
            along, across = outline[:, :1] * forward, outline[:, 1:] * left
            points = centre + _BODY_OVERSAMPLING * (along + across)
            draw.polygon([(x, y) for x, y in points.tolist()], fill=colour)

        body = _EGO if is_ego else _BODY
        fill(body, edge)
        fill(body * (0.86 if overlaps or is_ego else 0.93), colour)
        if t.acceleration[at] < _BRAKE_LIGHT:
            fill(_BRAKE, canvas.BRAKE)
            fill(_BRAKE * _MIRROR, canvas.BRAKE)
        # Positive: the target lane lies to the left.
        offset = float(t.target_lane[at] * t.label.lane_width_m - t.y[at])
        if abs(offset) > _SIGNAL_M and t.time_s[frame] % _BLINK_S < _LIT_S:
            for light in _INDICATORS:
                fill(light if offset > 0 else light * _MIRROR, canvas.AMBER)

        smooth = patch.reduce(_BODY_OVERSAMPLING)
        picture.paste(smooth, tuple(corner.tolist()), smooth)
        if self.look.speeds:
            place = (column - 0.09 * forward[0], middle[1] - SMALL * 0.62)
            ink = canvas.readable_on(colour)
            put_text(picture, place, f"{t.speed[at]:.0f}", ink, anchor=0.5)

    def _draw_trails(self, picture: Image.Image, frame: int, ego_x: float) -> None:
        """Trails over the last seconds, as in the paper's Figure 3.

        The ego's is brighter.
        """
        t = self.trajectory
        steps = round(self.look.trail_s / PHYSICS_STEP_S)
        past = slice(max(0, frame - steps), frame + 1)
        # What came before a jump belongs to another place.
        is_here = self._jumps[past] == self._jumps[frame]
        shown = t.valid[past] & t.valid[frame] & is_here
        # The mask is as high as the road, which takes less time than the whole picture.
        upper, lower = self.window.edges
        top = int(upper) - 20
        height = int(lower) + 20 - top
        mask = Image.new("L", (picture.width * _TRAIL_OVERSAMPLING, height * _TRAIL_OVERSAMPLING))
        columns, rows = self.window.column(t.x[past], ego_x), self.window.row(t.y[past]) - top
        places = np.stack((columns, rows), axis=-1) * _TRAIL_OVERSAMPLING
        draw = ImageDraw.Draw(mask)
        # The ego comes last, on top of the others.
        for vehicle in reversed(range(t.x.shape[1])):
            trail = [(x, y) for x, y in places[:, vehicle][shown[:, vehicle]].tolist()]
            coverage = _OTHER_COVERAGE if vehicle else _EGO_COVERAGE
            draw.line(trail, fill=coverage, width=2 * _TRAIL_OVERSAMPLING)
        picture.paste("white", (0, top), mask.reduce(_TRAIL_OVERSAMPLING))

    def _draw_header(self, picture: Image.Image, frame: int) -> None:
        """Put the header of one frame on the picture."""
        t, action = self.trajectory, int(self.trajectory.action[frame])
        values = (
            f"{t.time_s[frame]:.1f} s",
            f"{t.speed[frame, 0]:.1f} m/s",
            f"{t.returns[frame]:.1f}",
            # There is none before the first decision.
            "-" if action < 0 else NUMBERED[LANE_SPEED][action],
        )
        picture.paste(self._header, (0, 0))
        column = self._values_at
        for value, width in zip(values, _VALUES.values()):
            colour = canvas.EGO if value in ("left", "right") else canvas.TEXT
            put_text(picture, (column, 25), value, colour, 18)
            column += width

    def _draw_outcome(self, picture: Image.Image, ego_column: float) -> None:
        """How the episode ended, on a plate below the header; a crash has a ring."""
        outcome = self.trajectory.outcome
        if outcome not in _OUTCOMES:
            return
        draw = ImageDraw.Draw(picture)
        if outcome == "hard_crash":
            row, radius = float(self.window.row(self.trajectory.y[-1, 0])), 6.0 * self.window.along
            box = (ego_column - radius, row - radius, ego_column + radius, row + radius)
            draw.ellipse(box, outline=canvas.CRASH, width=3)
        text, colour = _OUTCOMES[outcome]
        width = canvas.text_mask(text, 24).width + 40
        left = (picture.width - width) // 2
        plate = (left, HEADER_HEIGHT + 6, left + width, HEADER_HEIGHT + 44)
        draw.rounded_rectangle(plate, 8, fill=canvas.HEADER, outline=colour, width=2)
        put_text(picture, (picture.width / 2, HEADER_HEIGHT + 11), text, colour, 24, 0.5)


def _header(label: EpisodeLabel, window: Window, values_at: int) -> Image.Image:
    """What stays in the line above the picture: driver, traffic, episode, titles of the values."""
    picture = Image.new("RGB", (window.width, HEADER_HEIGHT), canvas.HEADER)
    title = f"{label.agent}  on  {label.traffic}"
    put_text(picture, (16, 8), title, canvas.TEXT, _TITLE)
    lanes = f"{label.lanes} lane{'s' if label.lanes > 1 else ''}"
    facts = f"episode {label.episode}, seed {label.seed}, {lanes}"
    factor = window.across / window.along
    if factor > 1.05:
        facts += f"; drawn {factor:.1f} times as wide as it is"
    put_text(picture, (16, 34), facts)
    for name, width in _VALUES.items():
        put_text(picture, (values_at, 9), name)
        values_at += width
    return picture
