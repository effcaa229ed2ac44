"""Files of one lane, I-80's and I-24's, as scenes to drive.

``i80_1600_lane1.csv`` holds every car of one lane, all of which are driven (no lengths are given:
4.5 m). The others hold pairs, in which the follower is driven behind its recorded leader. I-24's
follower measured its own speed, and the gap by radar: no camera's noise is in it. All are cut into
segments of 15 s, each of which starts as recorded, on a road of one lane. Positions in the files
are of the front bumper; here they are of the centre, as everywhere.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from ganlane.data.dense import Recording
from ganlane.data.lanes import STANDARD_LANE_WIDTH_M, mean_speed, tracks_of_frame
from ganlane.data.schema import FRAME_S
from ganlane.data.tables import read_table
from ganlane.errors import UserError

#: Name to file, from the folder of NGSIM's scenes.
ONE_LANE_FILES = {
    "I-80, lane_1": "i80_1600_lane1.csv",
    "I-80, pairs": "i80_1600_pairs.csv",
    "I-80, following": "i80_following.csv",
    "I-24": "../i24/instrumented.csv",
}
#: Length of a segment, s.
SEGMENT_S = 15.0
#: The first seconds of a pair, in which the published smoothing bends the follower's speed, s.
EDGE_S = 3.0
#: Of a car whose size the file does not say.
_LENGTH_M = 4.5
_WIDTH_M = 2.0
#: No leader comes nearer, or gets away, by more than this within 0.1 s, m.
_JUMP_M = 2.0
#: A leader that the radar shows for less than this is none, but another echo, s.
_ECHO_S = 1.0
#: Columns that two of the files have in common.
_NUMBERS = {
    "vehicle": pl.Int64,
    "frame": pl.Int64,
    "x": pl.Float64,
}


def one_lane_files(scenes: Path) -> dict[str, Path]:
    """Those of :data:`ONE_LANE_FILES` that are there beside the file ``scenes``, by name."""
    files = {name: scenes.parent / file for name, file in ONE_LANE_FILES.items()}
    return {name: file for name, file in files.items() if file.is_file()}


def read_one_lane(name: str, path: Path) -> list[Recording]:
    """Segments of 15 s from the file ``path``, the one of :data:`ONE_LANE_FILES` called ``name``.

    Raises:
        UserError: it is damaged, or no track in it lasts 15 s.
    """
    # A scene is the lane, or a pair of cars.
    rows = _READERS[name](path)
    whole_lane = name == "I-80, lane_1"
    skip_s = 0.0 if whole_lane else EDGE_S
    pieces = []
    for scene in rows.partition_by("scene", maintain_order=True):
        for piece in _one_lane(scene).segments(SEGMENT_S, skip_s):
            # Nobody is driven where only a leader is there.
            if not piece.driven.any():
                continue
            # Each segment of the lane is a unit of its own: the whole lane would be a single unit,
            # and gives no interval.
            unit = piece.name if whole_lane else piece.unit
            pieces.append(replace(piece, unit=unit))
    if not pieces:
        raise UserError(f"{path}: nothing in it lasts {SEGMENT_S:g} s; give the whole file.")
    return pieces


# --- the readers: scene, vehicle, frame, x of the centre, length, and whether it is driven


def _lane(path: Path) -> pl.DataFrame:
    """Every car of I-80's lane 1."""
    return read_table(path, _NUMBERS).with_columns(
        scene=pl.lit("lane_1"),
        length=pl.lit(_LENGTH_M),
        x=pl.col("x") - 0.5 * _LENGTH_M,
        driven=True,
    )


def _pairs(path: Path) -> pl.DataFrame:
    """Pairs of cars on I-80; a row is one car of a pair."""
    columns = {
        "pair": pl.String,
        "role": pl.String,
        "length": pl.Float64,
        **_NUMBERS,
    }
    return read_table(path, columns).with_columns(
        scene="pair-" + pl.col("pair"),
        x=pl.col("x") - 0.5 * pl.col("length"),
        driven=pl.col("role") == "follower",
    )


def _following(path: Path) -> pl.DataFrame:
    """Pairs of cars on I-80; a row is both cars of a pair."""
    columns = {
        "period": pl.String,
        **dict.fromkeys(("follower", "leader", "frame"), pl.Int64),
        **dict.fromkeys(("x_follower", "x_leader", "leader_length"), pl.Float64),
    }
    table = read_table(path, columns)
    # The follower's length is not in the file.
    lengths = {
        "follower": pl.lit(_LENGTH_M),
        "leader": pl.col("leader_length"),
    }
    cars = []
    for role, length in lengths.items():
        car = table.select(
            "frame",
            scene=pl.concat_str("period", "follower", "leader", separator="-"),
            vehicle=role,
            x=pl.col(f"x_{role}") - 0.5 * length,
            length=length,
            driven=pl.lit(role == "follower"),
        )
        cars.append(car)
    return pl.concat(cars)


def _instrumented(path: Path) -> pl.DataFrame:
    """Drives of a car on I-24 that measured its own speed and the gap to its leader."""
    columns = {
        "drive": pl.String,
        "time_s": pl.Float64,
        "v": pl.Float64,
    }
    table = read_table(path, columns)
    # Where nobody was seen there is no number, so this column is not checked.
    gap = pl.read_csv(path, columns=["gap"], schema_overrides={"gap": pl.Float64})
    drives = table.with_columns(
        gap["gap"],
        scene="drive-" + pl.col("drive"),
        frame=(pl.col("time_s") / FRAME_S).round().cast(pl.Int64),
        # The way driven, from its own speed.
        x=(pl.col("v").cum_sum() * FRAME_S).over("drive"),
    )
    follower = drives.select("scene", "frame", "x", vehicle=0, driven=True)

    # A gap that jumps belongs to another leader.
    another = (pl.col("gap").diff().abs() > _JUMP_M).fill_null(True)
    leaders = drives.filter(pl.col("gap").is_not_null()).select(
        "scene",
        "frame",
        # From 1 on: 0 is the follower.
        vehicle=another.cum_sum(),
        x=pl.col("x") + pl.col("gap") + _LENGTH_M,
        driven=False,
    )
    # A single position would be a car that stands.
    seen_s = FRAME_S * pl.len().over("scene", "vehicle")
    leaders = leaders.filter(seen_s >= _ECHO_S)
    # Numbers of vehicles come in two types.
    cars = pl.concat([follower, leaders], how="diagonal_relaxed")
    return cars.with_columns(length=_LENGTH_M)


_READERS = {
    "I-80, lane_1": _lane,
    "I-80, pairs": _pairs,
    "I-80, following": _following,
    "I-24": _instrumented,
}


def _one_lane(rows: pl.DataFrame) -> Recording:
    """Cars of one lane, each track of which has a number of its own.

    A speed is the mean over the second around its frame, cut off at the ends of the track.
    """
    # The files are sorted by frame, or by pair.
    rows = rows.sort("vehicle", "frame")
    # Positions across the road are not given, and all lanes are alike.
    rows = rows.with_columns(y=0.0, lane=0, width=_WIDTH_M)
    lane_widths = {rows["scene"][0]: STANDARD_LANE_WIDTH_M}
    tracks = tracks_of_frame(rows, lane_widths)
    speed = mean_speed(rows["x"].to_numpy(), tracks, np.arange(len(rows)))

    # A gap splits a track, since a recording's tracks have none.
    rows = rows.with_columns(vehicle=pl.Series(tracks.begins).cum_sum(), speed=pl.Series(speed))
    return Recording.of(rows, STANDARD_LANE_WIDTH_M)
