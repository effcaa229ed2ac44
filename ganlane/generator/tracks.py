"""Recorded scenes as dense arrays: one row per frame, one column per vehicle, a mask for who is present."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from ganlane.errors import UserError

REQUIRED_COLUMNS = ("scene", "vehicle", "frame", "x", "y", "speed", "lane", "length", "width")


@dataclass(frozen=True)
class SceneTracks:
    """One recorded scene of T frames (0.1 s apart) and V vehicles; absent entries are 0 and not ``present``.

    Attributes:
        name: the scene's name.
        first_frame: frame number of row 0.
        vehicles: [V] vehicle numbers.
        positions: [T, V, 2] float64, centre of the body, m; x along the road, y to the left.
        lane: [T, V] int64, 0 is the rightmost.
        present: [T, V] bool.
        length, width: [V] float64, m.
    """

    name: str
    first_frame: int
    vehicles: np.ndarray
    positions: np.ndarray
    lane: np.ndarray
    present: np.ndarray
    length: np.ndarray
    width: np.ndarray


def _one_scene(name: str, rows: pl.DataFrame) -> SceneTracks:
    vehicles, column = np.unique(rows["vehicle"].to_numpy(), return_inverse=True)
    frame = rows["frame"].to_numpy()
    row = frame - frame.min()
    shape = (int(row.max()) + 1, len(vehicles))
    positions, lane = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.int64)
    present, size = np.zeros(shape, dtype=bool), np.zeros((2, len(vehicles)))
    positions[row, column] = rows.select("x", "y").to_numpy()
    lane[row, column] = rows["lane"].to_numpy()
    present[row, column] = True
    size[:, column] = rows.select("length", "width").to_numpy().T
    return SceneTracks(name, int(frame.min()), vehicles, positions, lane, present, size[0], size[1])


def scene_tracks(frame: pl.DataFrame) -> list[SceneTracks]:
    """Every scene of a trajectory frame (``ganlane.data``'s schema), in order of their names.

    Raises:
        UserError: a column is missing, or there is no row.
    """
    missing = [name for name in REQUIRED_COLUMNS if name not in frame.columns]
    if missing:
        raise UserError(
            f"trajectory frame: columns {missing} are missing; expected {list(REQUIRED_COLUMNS)}; "
            "read the recordings with ganlane.data.read_scenes."
        )
    if frame.is_empty():
        raise UserError("trajectory frame: no rows; give recordings of at least 1.7 s.")
    names = sorted(frame["scene"].unique().to_list())
    return [_one_scene(name, frame.filter(pl.col("scene") == name)) for name in names]
