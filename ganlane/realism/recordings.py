"""Recorded scenes as dense arrays: what simulations start from, and what they are measured against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ganlane.data import FRAME_S, SCHEMA

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: A scene must last longer than the part that is left out of every measure, s.
SHORTEST_S = 4.0


@dataclass(frozen=True)
class Recording:
    """A recorded scene of T frames (0.1 s apart) and V tracks; entries that are not ``present`` are 0.

    Attributes:
        name: the scene's; no other recording has it.
        unit: what is resampled together: the scene, or the pair that several stretches come from.
        lanes, lane_width_m: its road.
        x, y, speed: [T, V] centre of the body, m, and m/s.
        present: [T, V] recorded in this frame; a track has no gap.
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
    present: Flags
    length: Floats
    width: Floats
    driven: Flags

    @property
    def end_m(self) -> float:
        """Where its road ends, as far as the recording shows, m."""
        return float(self.x[self.present].max())


def recordings_of(
    frame: pl.DataFrame, lane_widths: Mapping[str, float], scenes: Sequence[str] | None = None
) -> list[Recording]:
    """The scenes of a frame in the schema, in the order of their names.

    Args:
        frame: in the schema; a track with a gap is taken to be there in it, at its last position.
        lane_widths: m, by scene.
        scenes: names; None takes all.
    """
    names = sorted(frame["scene"].unique().to_list() if scenes is None else scenes)
    return [_recording(name, frame.filter(pl.col("scene") == name), lane_widths[name]) for name in names]


def _recording(name: str, rows: pl.DataFrame, lane_width_m: float) -> Recording:
    vehicles, column = np.unique(rows["vehicle"].to_numpy(), return_inverse=True)
    frame = rows["frame"].to_numpy()
    row = frame - frame.min()
    shape = (int(row.max()) + 1, len(vehicles))
    dense = {field: np.zeros(shape) for field in ("x", "y", "speed")}
    for field, values in dense.items():
        values[row, column] = rows[field].to_numpy()
    present = np.zeros(shape, dtype=bool)
    present[row, column] = True
    size = {field: np.zeros(len(vehicles)) for field in ("length", "width")}
    for field, flat in size.items():
        flat[column] = rows[field].to_numpy()
    lanes = int(rows["lane"].to_numpy().max()) + 1
    everybody = np.ones(len(vehicles), dtype=bool)
    return Recording(name, name, lanes, lane_width_m, **dense, present=present, **size, driven=everybody)


def frame_of(recording: Recording, x: Floats, y: Floats, there: Flags, name: str) -> pl.DataFrame:
    """Trajectories [T, V] driven in the place of ``recording`` as a frame in the schema, sorted by track.

    The lane is the one whose centre is nearest, and the speed is 0: everything is measured from positions. The
    further columns ``unit`` and ``driven`` are the recording's.
    """
    vehicle, time = np.nonzero(there.T)
    width = recording.lane_width_m
    columns = {
        "scene": np.full(len(vehicle), name),
        "vehicle": vehicle,
        "frame": time,
        "x": x[time, vehicle].astype(np.float64),
        "y": y[time, vehicle].astype(np.float64),
        "speed": np.zeros(len(vehicle)),
        "lane": np.rint(y[time, vehicle] / width).astype(np.int64).clip(0, recording.lanes - 1),
        "length": recording.length[vehicle],
        "width": recording.width[vehicle],
    }
    whose = pl.lit(recording.unit).alias("unit")
    driven = pl.Series("driven", recording.driven[vehicle])
    return pl.DataFrame(columns, schema=SCHEMA).with_columns(whose, driven)


def recorded_frame(recordings: Sequence[Recording]) -> pl.DataFrame:
    """The recordings themselves, in the form in which simulations are measured."""
    return pl.concat([frame_of(each, each.x, each.y, each.present, each.name) for each in recordings])


def stretches(recording: Recording, seconds: float, skip_s: float = 0.0) -> list[Recording]:
    """``recording`` from ``skip_s`` on in pieces of so many seconds, with the vehicles present in each."""
    length, first = round(seconds / FRAME_S), round(skip_s / FRAME_S)
    pieces = []
    for start in range(first, len(recording.x) - length + 1, length):
        rows = slice(start, start + length)
        who = recording.present[rows].any(0)
        dense = {field: getattr(recording, field)[rows][:, who] for field in ("x", "y", "speed", "present")}
        flat = {field: getattr(recording, field)[who] for field in ("length", "width", "driven")}
        name = f"{recording.name}@{start}"
        pieces.append(Recording(name, recording.unit, recording.lanes, recording.lane_width_m, **dense, **flat))
    return pieces
