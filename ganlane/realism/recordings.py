"""Recorded scenes as dense arrays: the starts of simulations, and what those are measured against.

Two sources: scenes in the project's schema, and three files of I-80, a site that no generator was
fitted to. ``i80_1600_lane1.csv`` holds every car of one lane, all of which are driven (no lengths
are given: 4.5 m). The two others hold pairs, in which the follower is driven behind its recorded
leader. All three are cut into segments of 15 s, each of which starts as recorded, on a road of one
lane. Positions in the files are of the front bumper; here they are of the centre, as everywhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from ganlane.data import FRAME_S, SCHEMA
from ganlane.data.lanes import STANDARD_LANE_WIDTH_M, Flags, Floats
from ganlane.data.schema import read_table
from ganlane.errors import UserError

#: A scene must last longer than the seconds that every measure leaves out, s.
SHORTEST_S = 4.0
#: Name to file.
I80_FILES: Final = {
    "lane_1": "i80_1600_lane1.csv",
    "pairs": "i80_1600_pairs.csv",
    "following": "i80_following.csv",
}
SEGMENT_S: Final = 15.0
#: The first seconds of a pair, in which the published smoothing bends the follower's speed, s.
EDGE_S: Final = 3.0
_LENGTH_M: Final = 4.5
_WIDTH_M: Final = 2.0
_NUMBERS = {"frame": pl.Int64, "x": pl.Float64}


@dataclass(frozen=True)
class Recording:
    """A recorded scene of T frames (0.1 s apart) and V tracks; entries that are not ``present`` are
    0.

    Attributes:
        name: the scene's; no other recording has it.
        unit: what is resampled together: the scene, or the pair that several segments come from.
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


def recordings_of(frame: pl.DataFrame, lane_widths: Mapping[str, float]) -> list[Recording]:
    """The scenes of a frame in the schema, whose tracks have no gaps, by name.

    ``lane_widths`` are in m.
    """
    made = []
    for name in sorted(frame["scene"].unique().to_list()):
        rows = frame.filter(pl.col("scene") == name).with_columns(driven=pl.lit(True))
        track = np.unique(rows["vehicle"].to_numpy(), return_inverse=True)[1]
        made.append(
            _recording(name, rows, track, int(rows["lane"].to_numpy().max()) + 1, lane_widths[name])
        )
    return made


def _recording(
    name: str, rows: pl.DataFrame, track: np.ndarray, lanes: int, lane_width_m: float
) -> Recording:
    """The recording of ``rows`` [R], of which ``track`` [R] gives the index of each one's track."""
    time = rows["frame"].to_numpy() - rows["frame"].to_numpy().min()
    shape = (int(time.max()) + 1, int(track.max()) + 1)
    made: dict[str, Any] = {field: np.zeros(shape) for field in ("x", "y", "speed")}
    made |= {
        "length": np.zeros(shape[1]),
        "width": np.zeros(shape[1]),
        "driven": np.zeros(shape[1], dtype=bool),
    }
    for field, values in made.items():
        values[(time, track) if values.ndim == 2 else track] = rows[field].to_numpy()
    present = np.zeros(shape, dtype=bool)
    present[time, track] = True
    return Recording(name, name, lanes, lane_width_m, present=present, **made)


def frame_of(recording: Recording, x: Floats, y: Floats, present: Flags, name: str) -> pl.DataFrame:
    """Trajectories [T, V] of the vehicles of ``recording`` as a frame in the schema, sorted by
    track.

    The lane is the one whose centre is nearest, and the speed is 0: everything is measured from
    positions. Further columns are the recording's ``unit``, ``driven`` and ``lane_width``.
    """
    vehicle, time = np.nonzero(present.T)
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
    return pl.DataFrame(columns, schema=SCHEMA).with_columns(
        unit=pl.lit(recording.unit),
        driven=pl.Series(recording.driven[vehicle]),
        lane_width=pl.lit(width),
    )


def recorded_frame(recordings: Sequence[Recording]) -> pl.DataFrame:
    """The recordings in the form in which simulations are measured."""
    return pl.concat(
        [frame_of(each, each.x, each.y, each.present, each.name) for each in recordings]
    )


def units_of(recordings: Sequence[Recording]) -> list[str]:
    """Names of the units that the bootstrap resamples, in order."""
    return list(dict.fromkeys(each.unit for each in recordings))


def segments(recording: Recording, seconds: float, skip_s: float = 0.0) -> list[Recording]:
    """Cuts ``recording`` from ``skip_s`` on into pieces of ``seconds``, each with the vehicles
    present in it.
    """
    length, first = round(seconds / FRAME_S), round(skip_s / FRAME_S)
    pieces = []
    for start in range(first, len(recording.x) - length + 1, length):
        rows = slice(start, start + length)
        who = recording.present[rows].any(0)
        dense = {
            field: getattr(recording, field)[rows][:, who]
            for field in ("x", "y", "speed", "present")
        }
        flat = {field: getattr(recording, field)[who] for field in ("length", "width", "driven")}
        pieces.append(replace(recording, name=f"{recording.name}@{start}", **dense, **flat))
    return pieces


def read_i80(name: str, path: Path) -> list[Recording]:
    """Segments of 15 s from the file ``path``, which is the one of :data:`I80_FILES` called
    ``name``.

    Raises:
        UserError: it is damaged, or no track in it lasts 15 s.
    """
    pieces = [piece for piece in _I80_READERS[name](path) if piece.driven.any()]
    if not pieces:
        raise UserError(f"{path}: nothing in it lasts {SEGMENT_S:g} s; give the whole file.")
    return pieces


def _lane(path: Path) -> list[Recording]:
    rows = read_table(path, {"vehicle": pl.Int64, **_NUMBERS}).with_columns(
        length=pl.lit(_LENGTH_M), x=pl.col("x") - 0.5 * _LENGTH_M, driven=pl.lit(True)
    )
    # Each segment is a unit of its own: the whole lane would be a single unit, and gives no
    # interval.
    return [
        replace(piece, unit=piece.name) for piece in segments(_one_lane("lane_1", rows), SEGMENT_S)
    ]


def _pairs(path: Path) -> list[Recording]:
    columns = {
        "pair": pl.String,
        "role": pl.String,
        "vehicle": pl.Int64,
        "length": pl.Float64,
        **_NUMBERS,
    }
    rows = read_table(path, columns).with_columns(
        x=pl.col("x") - 0.5 * pl.col("length"), driven=pl.col("role") == "follower"
    )
    return _pair_segments("pair-", rows.group_by("pair", maintain_order=True))


def _following(path: Path) -> list[Recording]:
    whose = ["period", "follower", "leader"]
    kinds = {"period": pl.String, "follower": pl.Int64, "leader": pl.Int64, "frame": pl.Int64}
    table = read_table(
        path, kinds | dict.fromkeys(("x_follower", "x_leader", "leader_length"), pl.Float64)
    )

    def car(role: str, length: pl.Expr) -> pl.DataFrame:
        x, driven = pl.col(f"x_{role}") - 0.5 * length, pl.lit(role == "follower")
        return table.select(
            *whose, "frame", vehicle=pl.col(role), x=x, length=length, driven=driven
        )

    cars = pl.concat([car("follower", pl.lit(_LENGTH_M)), car("leader", pl.col("leader_length"))])
    return _pair_segments("", cars.group_by(whose, maintain_order=True))


_I80_READERS = {"lane_1": _lane, "pairs": _pairs, "following": _following}


def _pair_segments(
    prefix: str, pairs: Iterable[tuple[tuple[object, ...], pl.DataFrame]]
) -> list[Recording]:
    """The segments of all pairs of cars, by the names of the pairs."""
    recordings = (_one_lane(prefix + "-".join(map(str, name)), rows) for name, rows in pairs)
    return [piece for each in recordings for piece in segments(each, SEGMENT_S, EDGE_S)]


def _one_lane(name: str, rows: pl.DataFrame) -> Recording:
    """Cars of one lane.

    A speed is the mean over the second around its frame, cut off at the ends of the track.
    """
    rows = rows.sort("vehicle", "frame").with_columns(y=0.0, speed=0.0, width=_WIDTH_M)
    # A gap splits a track, since a recording's tracks have none.
    part = (
        ((pl.col("frame").diff() != 1) | (pl.col("vehicle").diff() != 0)).fill_null(False).cum_sum()
    )
    made = _recording(
        name, rows, rows.select(part).to_series().to_numpy(), 1, STANDARD_LANE_WIDTH_M
    )
    return replace(made, speed=_speeds(made.x, made.present))


def _speeds(x: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Speeds [T, V], m/s: over up to 0.5 s on either side, within the track."""
    index = np.arange(len(x))[:, None]
    first, last = present.argmax(0), len(x) - 1 - present[::-1].argmax(0)
    before, after = np.clip(index - 5, first, last), np.clip(index + 5, first, last)
    moved = np.take_along_axis(x, after, 0) - np.take_along_axis(x, before, 0)
    return np.where(present, moved / (np.maximum(after - before, 1) * FRAME_S), 0.0)
