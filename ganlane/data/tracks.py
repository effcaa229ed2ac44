"""Tracks as flat arrays: the common form in which recordings and simulations are measured.

The samples of a track are consecutive, 0.1 s apart; where a vehicle is missing for a sample, its track ends and
another begins. Everything is vectorised over all samples of all tracks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

from ganlane.data.lane_widths import scene_lane_widths
from ganlane.data.schema import FRAME_S

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Tracks:
    """R samples of any number of tracks, track by track.

    Attributes:
        y: [R] lateral position, m; lane k's centre is at ``k * lane_width``.
        lane_width: [R] m.
        begins: [R] true at the first sample of each track.
        step_s: time between two samples.
    """

    y: Floats
    lane_width: Floats
    begins: Flags
    step_s: float = FRAME_S

    @property
    def lane(self) -> Integers:
        """[R] lane whose centre is nearest."""
        return np.rint(self.y / self.lane_width).astype(np.int64)

    @property
    def first(self) -> Integers:
        """[R] index of the first sample of each sample's track."""
        return np.maximum.accumulate(np.where(self.begins, np.arange(len(self.y)), 0))

    @property
    def last(self) -> Integers:
        """[R] index of the last sample of each sample's track."""
        ends = np.append(np.flatnonzero(self.begins)[1:], len(self.y)) - 1
        return ends[np.cumsum(self.begins) - 1]


def tracks_of_frame(frame: pl.DataFrame, lane_widths: dict[str, float] | None = None) -> Tracks:
    """Tracks of a frame in the schema, sorted by scene, vehicle and frame; a missing frame splits a track.

    Args:
        frame: in the schema.
        lane_widths: width of each scene's lanes, m; by default :func:`scene_lane_widths`.
    """
    widths = scene_lane_widths(frame) if lane_widths is None else lane_widths
    goes_on = (pl.col("frame").diff() == 1) & (pl.col("vehicle").diff() == 0)
    same_scene = pl.col("scene") == pl.col("scene").shift(1)
    columns = frame.select(
        "y",
        width=pl.col("scene").replace_strict(widths, return_dtype=pl.Float64),
        begins=~(goes_on & same_scene).fill_null(False),
    )
    return Tracks(columns["y"].to_numpy(), columns["width"].to_numpy(), columns["begins"].to_numpy())


def tracks_of_arrays(
    y: ArrayLike,
    lane_width: float,
    valid: ArrayLike | None = None,
    begins: ArrayLike | None = None,
    step_s: float = FRAME_S,
) -> tuple[Tracks, Integers]:
    """Tracks from a simulation's arrays.

    Args:
        y: [T, K] lateral positions, m, of K vehicles at T samples.
        lane_width: m.
        valid: [T, K] false where there is no vehicle; all true by default.
        begins: [T, K] true where the column continues with another vehicle (a reset, a recycled vehicle); the first
            valid sample after a gap always begins a track.
        step_s: time between samples.

    Returns:
        The tracks, and [R, 2] the (time, column) of each sample in the arrays.
    """
    columns = np.asarray(y, dtype=np.float64).T
    there = np.ones(columns.shape, bool) if valid is None else np.asarray(valid, bool).T
    before = np.zeros_like(there)
    before[:, 1:] = there[:, :-1]
    fresh = ~before if begins is None else ~before | np.asarray(begins, bool).T
    column, time = np.nonzero(there)
    samples = columns[there]
    widths = np.full(len(samples), float(lane_width))
    return Tracks(samples, widths, fresh[there], step_s), np.stack((time, column), axis=1)
