"""Recorded or simulated scenes as dense arrays [frames, tracks], and back as frames in the schema.

The polars frame of :mod:`ganlane.data.schema` holds what was read; this form is for what goes frame
by frame: the starts of simulations, and what they drove.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import ArrayLike

from ganlane.data.lanes import Flags, Floats, Integers, scene_lane_widths
from ganlane.data.schema import FRAME_S, SCHEMA
from ganlane.errors import UserError

#: In fitting, a recorded driver's target lane is its lane after this time, s.
INTENTION_S = 2.0
#: Arrays [T, V] of a recording.
_OF_SAMPLES = ("x", "y", "speed", "lane", "present")
#: Arrays [V] of a recording.
_OF_TRACKS = ("length", "width", "driven")


@dataclass(frozen=True)
class Recording:
    """A scene of T frames (0.1 s apart) and V tracks; entries that are not ``present`` are 0.

    Attributes:
        name: the scene's; no other recording has it.
        unit: what is resampled together: the scene, or the pair that several segments come from.
        lanes, lane_width_m: its road.
        x, y, speed: [T, V] centre of the body, m, and m/s.
        lane: [T, V] as recorded; of simulations, the one whose centre is nearest.
        present: [T, V] in the scene in this frame; a track has no gap.
        length, width: [V] m.
        driven: [V] simulated; the others are replayed as recorded and left out of every measure.
    """

    name: str
    unit: str
    lanes: int
    lane_width_m: float
    x: Floats
    y: Floats
    speed: Floats
    lane: Integers
    present: Flags
    length: Floats
    width: Floats
    driven: Flags

    @classmethod
    def of(cls, rows: pl.DataFrame, lane_width_m: float) -> Recording:
        """From one scene in the schema whose tracks have no gaps.

        Args:
            rows: the scene. With a column ``driven``, the vehicles that are not are replayed.
            lane_width_m: width of its lanes, m.
        """
        rows = rows.with_columns(present=True)
        # Without the column everybody is driven.
        if "driven" not in rows.columns:
            rows = rows.with_columns(driven=True)

        # Of every row: its frame, counted from the scene's first one, and its track's index.
        frame = rows["frame"].to_numpy()
        time = frame - frame.min()
        _, track = np.unique(rows["vehicle"].to_numpy(), return_inverse=True)
        frames = int(time.max()) + 1
        tracks = int(track.max()) + 1

        arrays: dict[str, Any] = {}
        # 0 where a track is absent.
        for name in _OF_SAMPLES:
            column = rows[name].to_numpy()
            arrays[name] = np.zeros((frames, tracks), column.dtype)
            arrays[name][time, track] = column
        # Values per track are the same in all of its rows.
        for name in _OF_TRACKS:
            column = rows[name].to_numpy()
            arrays[name] = np.zeros(tracks, column.dtype)
            arrays[name][track] = column

        scene = str(rows["scene"][0])
        # Lane 0 is the rightmost; lanes beyond the leftmost one in use are not known.
        lanes = int(rows["lane"].to_numpy().max()) + 1
        return cls(scene, scene, lanes, lane_width_m, **arrays)

    @cached_property
    def positions(self) -> Floats:
        """``x`` and ``y`` side by side, [T, V, 2]."""
        return np.stack((self.x, self.y), -1)

    @cached_property
    def endless_positions(self) -> Floats:
        """Positions [T, V, 2], finite in every frame.

        They go on at constant velocity before a vehicle's first and after its last present frame.
        """
        positions = self.positions
        frames = np.arange(len(self.present))[:, None]
        column = np.arange(self.present.shape[1])
        first, last = self.ends
        # The frame to go on from, [T, V]: itself, or the first or last one of the track.
        nearest = np.clip(frames, first, last)

        # The first and the last displacement of each vehicle, m per frame, [V, 2]; 0 where it was
        # seen only once.
        second = np.minimum(first + 1, last)
        last_but_one = np.maximum(last - 1, first)
        early = positions[second, column] - positions[first, column]
        late = positions[last, column] - positions[last_but_one, column]
        is_before = (frames < first)[..., None]
        displacement = np.where(is_before, early, late)

        # Frames since the last, or until the first, recorded one; negative before it.
        beyond = (frames - nearest)[..., None]
        return positions[nearest, column] + displacement * beyond

    @cached_property
    def target_lane(self) -> Integers:
        """Lane [T, V] of each vehicle after :data:`INTENTION_S`, or at the end of its track."""
        frames = np.arange(len(self.present))[:, None]
        ahead = frames + round(INTENTION_S / FRAME_S)
        # Clipped, since the track may end before.
        within = np.clip(ahead, *self.ends)
        return np.take_along_axis(self.lane, within, axis=0)

    @property
    def ends(self) -> tuple[Integers, Integers]:
        """First and last present frame of each vehicle, [V] each."""
        # argmax is the first true entry; the last one is the first of the reversed frames.
        first = self.present.argmax(0)
        from_end = self.present[::-1].argmax(0)
        return first, len(self.present) - 1 - from_end

    @property
    def end_m(self) -> float:
        """Where its road ends, as far as the recording shows, m."""
        return float(self.x[self.present].max())

    def frame(self) -> pl.DataFrame:
        """Its trajectories in the schema, sorted by track, in the form that is measured.

        The lane is the one whose centre is nearest, and the speed is 0: everything is measured from
        positions. Further columns are ``unit``, ``driven`` and ``lane_width``.
        """
        # Simulated positions are float32; sums over them are taken in float64.
        y = self.y.astype(np.float64)
        nearest_lane = np.rint(y / self.lane_width_m).clip(0, self.lanes - 1)
        table = track_table(
            self.name,
            self.present,
            vehicle=np.arange(len(self.length)),
            x=self.x,
            y=y,
            speed=0.0,
            lane=nearest_lane,
            length=self.length,
            width=self.width,
        )
        # A row's vehicle is the column of its track.
        return table.with_columns(
            unit=pl.lit(self.unit),
            driven=pl.Series(self.driven[table["vehicle"].to_numpy()]),
            lane_width=pl.lit(self.lane_width_m),
        )

    def segments(self, seconds: float, skip_s: float = 0.0) -> list[Recording]:
        """Pieces of ``seconds`` from ``skip_s`` on, each with the vehicles present in it.

        A rest that is shorter is left out. Pieces are called by their first frame, as
        ``us-101-1@150``.
        """
        length = round(seconds / FRAME_S)
        first = round(skip_s / FRAME_S)
        last = len(self.x) - length
        pieces = []
        for start in range(first, last + 1, length):
            frames = slice(start, start + length)
            # Vehicles that are absent all the time are left out.
            is_seen = self.present[frames].any(0)
            arrays: dict[str, Any] = {}
            for name in _OF_SAMPLES:
                arrays[name] = getattr(self, name)[frames, is_seen]
            for name in _OF_TRACKS:
                arrays[name] = getattr(self, name)[is_seen]
            # The unit stays that of the recording: pieces of one scene are not independent.
            pieces.append(replace(self, name=f"{self.name}@{start}", **arrays))
        return pieces


def track_table(scene: str, present: Flags, **values: ArrayLike) -> pl.DataFrame:
    """A frame in the schema of one scene, track by track.

    Args:
        scene: its name.
        present: [T, V] where rows are made.
        **values: the other columns but ``frame``, each [T, V], [V] or one number.
    """
    # Transposed, so that the rows come track by track.
    track, frame = np.nonzero(present.T)
    columns: dict[str, Any] = {
        "scene": np.full(len(frame), scene),
        "frame": frame,
    }
    for name, value in values.items():
        numbers = np.broadcast_to(value, present.shape)[frame, track]
        columns[name] = numbers.astype(SCHEMA[name].to_python())
    # In the order of the schema.
    ordered = {name: columns[name] for name in SCHEMA}
    return pl.DataFrame(ordered, schema=SCHEMA)


def recordings_of(frame: pl.DataFrame) -> list[Recording]:
    """The scenes of a frame in the schema, by name.

    Raises:
        UserError: a column is missing, there is no row, or lanes are implausibly wide or narrow.
    """
    missing = [name for name in SCHEMA if name not in frame.columns]
    if missing or frame.is_empty():
        raise UserError(
            f"a frame without {missing or 'rows'}: expected {list(SCHEMA)}; read recordings with "
            "ganlane.data.read_scenes."
        )
    lane_widths = scene_lane_widths(frame)
    scenes = frame.partition_by("scene", as_dict=True)
    recordings = []
    # Sorted by name, so that the order of the file has no effect.
    for key in sorted(scenes):
        (scene,) = key
        recordings.append(Recording.of(scenes[key], lane_widths[str(scene)]))
    return recordings


def units_of(recordings: Sequence[Recording]) -> list[str]:
    """Names of the units that the bootstrap resamples, in order."""
    return list(dict.fromkeys(recording.unit for recording in recordings))
