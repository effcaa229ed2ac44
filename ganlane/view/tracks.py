"""Recorded episodes as tracks of recorded traffic."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl

from ganlane.data.dense import track_table
from ganlane.data.recordings import scene_csv, write_prepared
from ganlane.data.schema import TRACK_STRIDE, sort
from ganlane.files import opened
from ganlane.view.record import Trajectory


def write_tracks(
    trajectories: Sequence[Trajectory], path: str | Path, format: Literal["csv", "parquet"]
) -> Path:
    """Write episodes, atomically, as a file that :func:`ganlane.data.read_scenes` reads back.

    Each is a scene, ``AGENT_TRAFFIC_SEED_EPISODE``; a number follows where two would be alike.
    Parquet holds the schema (:mod:`ganlane.data.schema`) itself. In CSV, the form of recordings
    from elsewhere, the speed is called ``v``, lanes are counted from the left, from 1, and ``y`` is
    0 at the centre of lane 1. It has no lane width, and a rightmost lane without vehicles is lost.
    """
    # The same driver, traffic, seed and episode may come twice; scenes need names of their own.
    times = Counter[str]()
    tables = []
    for trajectory in trajectories:
        label = trajectory.label
        name = f"{Path(label.agent).stem}_{label.traffic}_{label.seed}_{label.episode}"
        times[name] += 1
        number = f"-{times[name]}" if times[name] > 1 else ""
        table = to_tracks(trajectory, name + number)
        if format == "csv":
            # A scene CSV counts lanes from the left, so it needs the number of the leftmost one.
            table = scene_csv(table, pl.lit(label.lanes - 1), label.lane_width_m)
        tables.append(table)
    if format == "parquet":
        write_prepared(sort(pl.concat(tables)), path)
    else:
        with opened(path) as file:
            pl.concat(tables).write_csv(file)
    return Path(path)


def to_tracks(trajectory: Trajectory, scene: str = "simulated") -> pl.DataFrame:
    """The trajectory in the schema of recordings; a recycled vehicle begins a new track."""
    # Numbers of later tracks lie a whole stride higher, so none is used twice.
    jumps = np.cumsum(trajectory.jumped(), axis=0)
    numbers = np.arange(jumps.shape[1]) + TRACK_STRIDE * jumps
    values = {name: getattr(trajectory, name) for name in ("x", "y", "speed", "length", "width")}
    lane = trajectory.lane()
    return sort(track_table(scene, trajectory.valid, vehicle=numbers, lane=lane, **values))
