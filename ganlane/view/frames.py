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
        trajectory = self.trajectory
        ego_x = float(trajectory.x[frame, 0])
        picture = self._backdrop.at(ego_x)
        self._draw_trails(picture, frame, ego_x)

        # Of all vehicles, [M], pixels.
        columns = self.window.column(trajectory.x[frame], ego_x)
        lengths = trajectory.length[frame] * self.window.along
        in_picture = (columns > -lengths) & (columns < self.window.width + lengths)
        shown = np.flatnonzero(in_picture & trajectory.valid[frame])
        # The ego comes last, on top of the others.
        for vehicle in shown[::-1].tolist():
            self._draw_vehicle(picture, frame, vehicle, float(columns[vehicle]))

        if frame == len(trajectory) - 1:
            self._draw_outcome(picture, float(columns[0]))
        self._draw_header(picture, frame)
        return np.asarray(picture)

    def _draw_vehicle(self, picture: Image.Image, frame: int, vehicle: int, column: float) -> None:
        """A box to scale, its centre in this column, with its speed in m/s on the roof."""
        trajectory = self.trajectory
        window = self.window
        at = (frame, vehicle)
        middle = np.array([column, float(window.row(trajectory.y[at]))])

        # Pixels (column, row) from end to end and from side to side. Rows of the picture count
        # downwards, so what points to the left has a negative row.
        cos = np.cos(trajectory.heading[at])
        sin = np.sin(trajectory.heading[at])
        forward = np.array([cos * window.along, -sin * window.across]) * trajectory.length[at]
        left = np.array([-sin * window.along, -cos * window.across]) * trajectory.width[at]

        # The vehicle is drawn on a patch around its middle, enlarged.
        reach = np.ceil((np.abs(forward) + np.abs(left)) / 2 + 3).astype(int)
        corner = np.floor(middle).astype(int) - reach
        centre = (middle - corner) * _BODY_OVERSAMPLING
        width, height = ((2 * reach + 1) * _BODY_OVERSAMPLING).tolist()

        speed = float(trajectory.speed[at])
        colour = canvas.EGO if vehicle == 0 else canvas.speed_tint(speed)
        layers = self._layers(frame, vehicle, colour)
        _, edge = layers[0]
        # Transparent in the colour of the edge, so that no other colour shows through it.
        patch = Image.new("RGBA", (width, height), f"{edge}00")
        draw = ImageDraw.Draw(patch)
        for outline, fill in layers:
            along, across = outline[:, :1] * forward, outline[:, 1:] * left
            points = centre + _BODY_OVERSAMPLING * (along + across)
            draw.polygon(points.flatten().tolist(), fill=fill)
        smooth = patch.reduce(_BODY_OVERSAMPLING)
        picture.paste(smooth, tuple(corner.tolist()), smooth)

        if self.look.speeds:
            place = (column - 0.09 * forward[0], middle[1] - SMALL * 0.62)
            put_text(picture, place, f"{speed:.0f}", canvas.readable_on(colour), anchor=0.5)

    def _layers(self, frame: int, vehicle: int, colour: str) -> list[tuple[FloatArray, str]]:
        """What a vehicle of this colour is drawn of, outlines and their colours, the lowest first.

        Its edge, its body, and the lights that are on. Outlines [points, 2] are shares of length
        and width.
        """
        trajectory = self.trajectory
        at = (frame, vehicle)
        is_ego = vehicle == 0
        overlaps = bool(self._overlapping[at])
        edge = canvas.TEXT if is_ego else canvas.darker(colour)
        if overlaps:
            edge = canvas.CRASH
        outline = _EGO if is_ego else _BODY
        # An edge that says something is broader.
        inside = 0.86 if overlaps or is_ego else 0.93
        layers = [(outline, edge), (outline * inside, colour)]

        if trajectory.acceleration[at] < _BRAKE_LIGHT:
            layers += [(_BRAKE, canvas.BRAKE), (_BRAKE * _MIRROR, canvas.BRAKE)]

        # Positive: the target lane lies to the left.
        target_y = trajectory.target_lane[at] * trajectory.label.lane_width_m
        offset = float(target_y - trajectory.y[at])
        if abs(offset) > _SIGNAL_M and trajectory.time_s[frame] % _BLINK_S < _LIT_S:
            for light in _INDICATORS:
                layers.append((light if offset > 0 else light * _MIRROR, canvas.AMBER))
        return layers

    def _draw_trails(self, picture: Image.Image, frame: int, ego_x: float) -> None:
        """Trails over the last seconds, as in the paper's Figure 3.

        The ego's is brighter.
        """
        trajectory = self.trajectory
        steps = round(self.look.trail_s / PHYSICS_STEP_S)
        past = slice(max(0, frame - steps), frame + 1)
        # What came before a jump belongs to another place.
        is_here = self._jumps[past] == self._jumps[frame]
        shown = trajectory.valid[past] & trajectory.valid[frame] & is_here

        # The mask is as high as the road, which takes less time than the whole picture.
        upper, lower = self.window.edges
        top = int(upper) - 20
        height = int(lower) + 20 - top
        mask = Image.new("L", (picture.width * _TRAIL_OVERSAMPLING, height * _TRAIL_OVERSAMPLING))
        draw = ImageDraw.Draw(mask)

        # [frames, M, 2]: column and row of every vehicle in the mask.
        columns = self.window.column(trajectory.x[past], ego_x)
        rows = self.window.row(trajectory.y[past]) - top
        places = np.stack((columns, rows), axis=-1) * _TRAIL_OVERSAMPLING
        # The ego comes last, on top of the others.
        for vehicle in reversed(range(trajectory.x.shape[1])):
            trail = places[:, vehicle][shown[:, vehicle]]
            coverage = _OTHER_COVERAGE if vehicle else _EGO_COVERAGE
            draw.line(trail.flatten().tolist(), fill=coverage, width=2 * _TRAIL_OVERSAMPLING)
        picture.paste("white", (0, top), mask.reduce(_TRAIL_OVERSAMPLING))

    def _draw_header(self, picture: Image.Image, frame: int) -> None:
        """Put the header of one frame on the picture."""
        trajectory = self.trajectory
        action = int(trajectory.action[frame])
        # In the order of _VALUES.
        values = (
            f"{trajectory.time_s[frame]:.1f} s",
            f"{trajectory.speed[frame, 0]:.1f} m/s",
            f"{trajectory.returns[frame]:.1f}",
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
            row = float(self.window.row(self.trajectory.y[-1, 0]))
            radius = 6.0 * self.window.along
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
