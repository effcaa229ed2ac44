"""I-80, a site that no generator was fitted to: three files beside the US-101 scenes, longitudinal only.

``i80_1600_lane1.csv`` holds every car of one lane, all of which are driven (no lengths are given: 4.5 m). The two
others hold pairs; there the follower is driven behind its recorded leader. All are cut into stretches of 15 s, each
of which starts as recorded, on a road of one lane. Positions in the files are of the front; here they are of the
centre, as everywhere. A pair's first 3 s, in which the published smoothing bends the follower's speed, are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from ganlane.data.lane_widths import STANDARD_LANE_WIDTH_M
from ganlane.data.schema import FRAME_S
from ganlane.data.tables import read_table
from ganlane.errors import UserError
from ganlane.evaluation.realism.card import quantity_rows
from ganlane.evaluation.realism.driving import Report, drive_all, measure_recordings, units_of
from ganlane.evaluation.realism.recordings import Recording, stretches
from ganlane.evaluation.realism.simulation import Factory, StartOptions

#: Name to file.
I80_FILES: Final = {"lane_1": "i80_1600_lane1.csv", "pairs": "i80_1600_pairs.csv", "following": "i80_following.csv"}
#: What can be said of one lane.
I80_QUANTITIES: Final = ("speed", "acceleration", "time_headway")
STRETCH_S: Final = 15.0
#: The first seconds of a pair, in which the published smoothing bends the follower's speed, s.
EDGE_S: Final = 3.0
_LENGTH_M: Final = 4.5
_WIDTH_M: Final = 2.0
_NUMBERS = {"frame": pl.Int64, "x": pl.Float64}


def i80_files(folder: Path) -> dict[str, Path]:
    """Those of the three files that lie in ``folder``, by name."""
    return {name: folder / file for name, file in I80_FILES.items() if (folder / file).is_file()}


def read_i80(name: str, path: Path) -> list[Recording]:
    """Stretches of 15 s from one of the files.

    Args:
        name: which of :data:`I80_FILES` it is.
        path: the file.

    Raises:
        UserError: it is damaged, or holds nothing that lasts 15 s.
    """
    readers = {"lane_1": _lane, "pairs": _pairs, "following": _following}
    whole = readers[name](path)
    pieces = [piece for each in whole for piece in each if piece.driven.any()]
    if not pieces:
        raise UserError(f"{path}: nothing in it lasts {STRETCH_S:g} s; give the whole file.")
    return pieces


def _lane(path: Path) -> list[list[Recording]]:
    rows = read_table(path, {"vehicle": pl.Int64, **_NUMBERS}).with_columns(
        length=pl.lit(_LENGTH_M), x=pl.col("x") - 0.5 * _LENGTH_M, driven=pl.lit(True)
    )
    # A stretch is a unit of its own: the whole lane would be a single one.
    whole = _recording("lane_1", rows)
    return [[_own_unit(piece) for piece in stretches(whole, STRETCH_S)]]


def _own_unit(piece: Recording) -> Recording:
    return Recording(**{**vars(piece), "unit": piece.name})


def _pairs(path: Path) -> list[list[Recording]]:
    columns = {"pair": pl.String, "role": pl.String, "vehicle": pl.Int64, "length": pl.Float64, **_NUMBERS}
    rows = read_table(path, columns).with_columns(
        x=pl.col("x") - 0.5 * pl.col("length"), driven=pl.col("role") == "follower"
    )
    groups = rows.group_by("pair", maintain_order=True)
    return [_cut(_recording(f"pair-{name}", group)) for (name,), group in groups]


def _following(path: Path) -> list[list[Recording]]:
    names = ("x_follower", "x_leader", "leader_length")
    columns = {"period": pl.String, "follower": pl.Int64, "leader": pl.Int64, "frame": pl.Int64}
    table = read_table(path, columns | {name: pl.Float64 for name in names})
    length = pl.col("leader_length")
    behind = table.select(
        "period", "follower", "leader", "frame",
        vehicle=pl.col("follower"), x=pl.col("x_follower") - 0.5 * _LENGTH_M,
        length=pl.lit(_LENGTH_M), driven=pl.lit(True),
    )  # fmt: skip
    ahead = table.select(
        "period", "follower", "leader", "frame",
        vehicle=pl.col("leader"), x=pl.col("x_leader") - 0.5 * length, length=length, driven=pl.lit(False),
    )  # fmt: skip
    groups = pl.concat([behind, ahead]).group_by("period", "follower", "leader", maintain_order=True)
    return [_cut(_recording("-".join(map(str, name)), rows)) for name, rows in groups]


def _cut(pair: Recording) -> list[Recording]:
    return stretches(pair, STRETCH_S, EDGE_S)


def _recording(name: str, rows: pl.DataFrame) -> Recording:
    """One lane of cars; the speed is the mean over the second about a frame, as far as the track goes."""
    rows = rows.sort("vehicle", "frame")
    # A gap splits a track, since a recording's tracks have none.
    part = ((pl.col("frame").diff() != 1) | (pl.col("vehicle").diff() != 0)).fill_null(False).cum_sum()
    rows = rows.with_columns(column=part, row=pl.col("frame") - pl.col("frame").min())
    row, column = rows["row"].to_numpy(), rows["column"].to_numpy()
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    x, present = np.zeros(shape), np.zeros(shape, dtype=bool)
    x[row, column], present[row, column] = rows["x"].to_numpy(), True
    flat = {field: np.zeros(shape[1], dtype=kind) for field, kind in (("length", float), ("driven", bool))}
    for field, values in flat.items():
        values[column] = rows[field].to_numpy()
    return Recording(
        name, name, 1, STANDARD_LANE_WIDTH_M, x, np.zeros(shape), _speeds(x, present), present,
        flat["length"], np.full(shape[1], _WIDTH_M), flat["driven"],
    )  # fmt: skip


def _speeds(x: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Speeds [T, V], m/s: over up to 0.5 s on either side, within the track."""
    index = np.arange(len(x))[:, None]
    first, last = present.argmax(0), len(x) - 1 - present[::-1].argmax(0)
    before, after = np.clip(index - 5, first, last), np.clip(index + 5, first, last)
    moved = np.take_along_axis(x, after, 0) - np.take_along_axis(x, before, 0)
    return np.where(present, moved / (np.maximum(after - before, 1) * FRAME_S), 0.0)


def i80_cards(
    makers: Mapping[str, Factory],
    files: Mapping[str, Path],
    options: Mapping[str, StartOptions],
    resamples: int,
    report: Report,
) -> dict[str, Any]:
    """By file, the rows of :func:`ganlane.evaluation.realism.card.quantity_rows`; nothing is fitted to the site.

    Args:
        makers: traffics by name, the card's own first.
        files: by name (:func:`i80_files`).
        options: by traffic, how it is driven; each stretch is driven once.
        resamples: of the bootstrap, over pairs or stretches.
        report: told what begins.
    """
    cards, once = {}, {name: replace(each, repeats=1) for name, each in options.items()}
    for name, path in files.items():
        recordings = read_i80(name, path)
        driven = drive_all(makers, recordings, once, report)
        measured, units = measure_recordings(recordings), units_of(recordings)
        recorded = {quantity: measured.counts(units, quantity) for quantity in I80_QUANTITIES}
        own, *_ = makers
        others = {other: each for other, each in driven.items() if other != own}
        cards[name] = quantity_rows(driven[own], others, recorded, {}, resamples=resamples)
    return cards
