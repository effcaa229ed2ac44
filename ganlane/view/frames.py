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
#: Indicators are lit for the first ``_LIT_S`` of every ``_BLINK_S``, in simulated time.
_BLINK_S = 0.6
_LIT_S = 0.6 * _BLINK_S
#: Bodies and trails are drawn so many times larger and reduced, which smooths their edges.
_BODY_OVERSAMPLING = 3
_TRAIL_OVERSAMPLING = 2
#: Coverage (0 to 255) of the ego's trail and of the others'.
_EGO_COVERAGE = 200
_OTHER_COVERAGE = 90

#: Moves a point, as shares of length and width, from the left side to the right one.
_MIRROR = (1.0, -1.0)


def _symmetric(*left: tuple[float, float]) -> FloatArray:
    """An outline [points, 2] from its left half, which goes from the rear to the front.

    Points are shares of a vehicle's length (to the front) and width (to the left), from its
    centre: (0.5, 0.5) is the front left corner.
    """
    half = np.array(left)
    # Back on the right side, from the front to the rear.
    return np.concatenate((half, half[::-1] * _MIRROR))


# A box with cut corners for the others, and a pointed one for the ego.
_BODY = _symmetric(
    (-0.5, 0.42),
    (-0.46, 0.5),
    (0.38, 0.5),
    (0.5, 0.34),
)
_EGO = _symmetric(
    (-0.5, 0.5),
    (0.2, 0.5),
    (0.5, 0.08),
)

# Lights of the left side, in the same shares: one at the rear, indicators at front and rear.
_BRAKE = np.array(
    [
        (-0.5, 0.42),
        (-0.44, 0.42),
        (-0.44, 0.2),
        (-0.5, 0.2),
    ]
)
_FRONT_INDICATOR = np.array(
    [
        (0.32, 0.5),
        (0.38, 0.5),
        (0.5, 0.34),
        (0.5, 0.2),
        (0.40, 0.26),
    ]
)
_REAR_INDICATOR = np.array(
    [
        (-0.46, 0.5),
        (-0.36, 0.5),
        (-0.40, 0.28),
        (-0.5, 0.24),
        (-0.5, 0.42),
    ]
)

#: Titles and widths in pixels of the header's values, from left to right.
_VALUES = {
    "time": 90,
    "speed": 100,
    "return": 90,
    "action": 80,
}
#: Sizes of the letters of the title, the values and the outcome, pixels.
_TITLE = 17
_VALUE = 18
_OUTCOME = 24
#: By end event what the last frame says, and in which colour.
_OUTCOMES = {
    "goal": ("GOAL", canvas.GOOD),
    "hard_crash": ("HARD CRASH", canvas.CRASH),
    "out_of_road": ("OUT OF ROAD", canvas.CRASH),
    "missed_exit": ("EXIT MISSED", canvas.AMBER),
    "timeout": ("TIME-OUT", canvas.AMBER),
    "scene_end": ("END OF RECORDING", canvas.AMBER),
}


class FramePainter:
    """Draws the frames of one trajectory.

    Everything that stays the same, the road and the header's title, is drawn once.

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

        # The values stand at the right, 10 pixels from the edge.
        self._values_at = self.window.width - sum(_VALUES.values()) - 10
        self._header = _header(label, self.window, self._values_at)

        self._overlapping = trajectory.overlapping()
        # How often a vehicle has jumped so far, [T, M]; trails are cut where this number changes.
        self._jumps = np.cumsum(trajectory.jumped(), axis=0)

    def draw(self, frame: int) -> Picture:
        """The picture of one frame, [height, width, 3], from 0 to 255."""
        trajectory = self.trajectory
        # The picture moves along with the ego.
        ego_x = float(trajectory.x[frame, 0])
        picture = self._backdrop.at(ego_x)
        self._draw_trails(picture, frame, ego_x)

        # Of all vehicles, [M], pixels.
        columns = self.window.column(trajectory.x[frame], ego_x)
        lengths = trajectory.length[frame] * self.window.along
        # A vehicle's length more at both ends, so that no part of one is missing.
        begins = columns > -lengths
        ends = columns < self.window.width + lengths
        shown = np.flatnonzero(begins & ends & trajectory.valid[frame])
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
        row = float(window.row(trajectory.y[at]))
        middle = np.array([column, row])

        # Pixels (column, row) from end to end and from side to side. Rows of the picture count
        # downwards, so what points to the left has a negative row.
        cos = np.cos(trajectory.heading[at])
        sin = np.sin(trajectory.heading[at])
        ahead = np.array([cos * window.along, -sin * window.across])
        sideways = np.array([-sin * window.along, -cos * window.across])
        forward = ahead * trajectory.length[at]
        left = sideways * trajectory.width[at]

        # The vehicle is drawn on a patch around its middle, enlarged. The patch reaches as far as a
        # corner of the box, and 3 pixels further, for the smoothing.
        half_size = (np.abs(forward) + np.abs(left)) / 2
        reach = np.ceil(half_size + 3).astype(int)
        corner = np.floor(middle).astype(int) - reach
        size = (2 * reach + 1) * _BODY_OVERSAMPLING
        # The vehicle's centre within the patch.
        centre = (middle - corner) * _BODY_OVERSAMPLING

        speed = float(trajectory.speed[at])
        colour = canvas.EGO if vehicle == 0 else canvas.speed_tint(speed)
        layers = self._layers(frame, vehicle, colour)
        _, edge = layers[0]
        # Transparent in the colour of the edge, so that no other colour shows through it.
        patch = Image.new("RGBA", tuple(size.tolist()), f"{edge}00")
        draw = ImageDraw.Draw(patch)
        for outline, fill in layers:
            along = outline[:, :1] * forward
            across = outline[:, 1:] * left
            points = centre + _BODY_OVERSAMPLING * (along + across)
            draw.polygon(points.flatten().tolist(), fill=fill)
        smooth = patch.reduce(_BODY_OVERSAMPLING)
        picture.paste(smooth, tuple(corner.tolist()), smooth)

        if self.look.speeds:
            # A little behind the centre, since the ego is pointed; text is placed by its top.
            place = (column - 0.09 * forward[0], row - SMALL * 0.62)
            ink = canvas.readable_on(colour)
            put_text(picture, place, f"{speed:.0f}", ink, anchor=0.5)

    def _layers(self, frame: int, vehicle: int, colour: str) -> list[tuple[FloatArray, str]]:
        """What a vehicle of this colour is drawn of, outlines and their colours, the lowest first.

        Its edge, its body, and the lights that are on. Outlines [points, 2] are shares of length
        and width, as those of :func:`_symmetric`.
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
        layers = [
            (outline, edge),
            (outline * inside, colour),
        ]

        if trajectory.acceleration[at] < _BRAKE_LIGHT:
            layers.append((_BRAKE, canvas.BRAKE))
            layers.append((_BRAKE * _MIRROR, canvas.BRAKE))

        # Positive: the target lane lies to the left.
        target_y = trajectory.target_lane[at] * trajectory.label.lane_width_m
        offset = float(target_y - trajectory.y[at])
        is_lit = trajectory.time_s[frame] % _BLINK_S < _LIT_S
        if abs(offset) > _SIGNAL_M and is_lit:
            for light in (_FRONT_INDICATOR, _REAR_INDICATOR):
                on_its_side = light if offset > 0 else light * _MIRROR
                layers.append((on_its_side, canvas.AMBER))
        return layers

    def _draw_trails(self, picture: Image.Image, frame: int, ego_x: float) -> None:
        """Trails over the last seconds, as in the paper's Figure 3.

        The ego's is brighter.
        """
        trajectory = self.trajectory
        steps = round(self.look.trail_s / PHYSICS_STEP_S)
        past = slice(max(0, frame - steps), frame + 1)
        # Which points of the trails are drawn, [frames, M]. What came before a jump belongs to
        # another place.
        is_here = self._jumps[past] == self._jumps[frame]
        shown = trajectory.valid[past] & trajectory.valid[frame] & is_here

        # The mask is as high as the road, which takes less time than the whole picture; vehicles
        # may leave the road by 20 pixels.
        upper, lower = self.window.edges
        top = int(upper) - 20
        height = int(lower) + 20 - top
        size = (picture.width * _TRAIL_OVERSAMPLING, height * _TRAIL_OVERSAMPLING)
        mask = Image.new("L", size)
        draw = ImageDraw.Draw(mask)

        # [frames, M, 2]: column and row of every vehicle in the mask.
        columns = self.window.column(trajectory.x[past], ego_x)
        rows = self.window.row(trajectory.y[past]) - top
        places = np.stack((columns, rows), axis=-1) * _TRAIL_OVERSAMPLING
        # The ego comes last, on top of the others.
        for vehicle in reversed(range(trajectory.x.shape[1])):
            trail = places[:, vehicle][shown[:, vehicle]]
            coverage = _EGO_COVERAGE if vehicle == 0 else _OTHER_COVERAGE
            # Two pixels wide in the picture.
            draw.line(trail.flatten().tolist(), fill=coverage, width=2 * _TRAIL_OVERSAMPLING)
        picture.paste("white", (0, top), mask.reduce(_TRAIL_OVERSAMPLING))

    def _draw_header(self, picture: Image.Image, frame: int) -> None:
        """Put the header of one frame on the picture."""
        trajectory = self.trajectory
        # There is no action before the first decision.
        number = int(trajectory.action[frame])
        action = "-" if number < 0 else NUMBERED[LANE_SPEED][number]
        # In the order of _VALUES.
        values = (
            f"{trajectory.time_s[frame]:.1f} s",
            f"{trajectory.speed[frame, 0]:.1f} m/s",
            f"{trajectory.returns[frame]:.1f}",
            action,
        )

        picture.paste(self._header, (0, 0))
        column = self._values_at
        for value, width in zip(values, _VALUES.values()):
            # Lane changes stand out among the actions.
            colour = canvas.EGO if value in ("left", "right") else canvas.TEXT
            put_text(picture, (column, 25), value, colour, _VALUE)
            column += width

    def _draw_outcome(self, picture: Image.Image, ego_column: float) -> None:
        """How the episode ended, on a plate below the header; a crash has a ring."""
        outcome = self.trajectory.outcome
        # An episode that was cut off has none.
        if outcome not in _OUTCOMES:
            return
        draw = ImageDraw.Draw(picture)

        if outcome == "hard_crash":
            row = float(self.window.row(self.trajectory.y[-1, 0]))
            # 6 m along the road.
            radius = 6.0 * self.window.along
            draw.ellipse(
                (ego_column - radius, row - radius, ego_column + radius, row + radius),
                outline=canvas.CRASH,
                width=3,
            )

        text, colour = _OUTCOMES[outcome]
        # A margin of 20 pixels at each side of the text.
        width = canvas.text_mask(text, _OUTCOME).width + 40
        left = (picture.width - width) // 2
        plate = (left, HEADER_HEIGHT + 6, left + width, HEADER_HEIGHT + 44)
        draw.rounded_rectangle(plate, 8, fill=canvas.HEADER, outline=colour, width=2)
        place = (picture.width / 2, HEADER_HEIGHT + 11)
        put_text(picture, place, text, colour, _OUTCOME, anchor=0.5)


def _header(label: EpisodeLabel, window: Window, values_at: int) -> Image.Image:
    """The part of the header that stays: driver, traffic, episode, titles of the values.

    The values' titles begin in the column ``values_at``.
    """
    picture = Image.new("RGB", (window.width, HEADER_HEIGHT), canvas.HEADER)
    title = f"{label.agent}  on  {label.traffic}"
    put_text(picture, (16, 8), title, canvas.TEXT, _TITLE)

    lanes = "1 lane" if label.lanes == 1 else f"{label.lanes} lanes"
    facts = f"episode {label.episode}, seed {label.seed}, {lanes}"
    # Less than 5 % does not show.
    factor = window.across / window.along
    if factor > 1.05:
        facts += f"; drawn {factor:.1f} times as wide as it is"
    put_text(picture, (16, 34), facts)

    column = values_at
    for name, width in _VALUES.items():
        put_text(picture, (column, 9), name)
        column += width
    return picture
