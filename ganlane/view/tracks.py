"""Recorded episodes as tracks of recorded traffic."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl

from ganlane.data.dense import track_table
from ganlane.data.recordings import write_prepared
from ganlane.data.schema import TRACK_STRIDE, sort
from ganlane.view.record import Trajectory


def write_tracks(trajectories: Sequence[Trajectory], path: str | Path) -> Path:
    """Write episodes, atomically, as a file that :func:`ganlane.data.read_scenes` reads back.

    Each is a scene, ``AGENT_TRAFFIC_SEED_EPISODE``; a number follows where two would be alike. It
    is Parquet in the schema of recordings (:mod:`ganlane.data.schema`).
    """
    # The same driver, traffic, seed and episode may come twice; scenes need names of their own.
    times = Counter[str]()
    tables = []
    for trajectory in trajectories:
        label = trajectory.label
        name = f"{Path(label.agent).stem}_{label.traffic}_{label.seed}_{label.episode}"
        times[name] += 1
        number = f"-{times[name]}" if times[name] > 1 else ""
        tables.append(to_tracks(trajectory, name + number))
    write_prepared(sort(pl.concat(tables)), path)
    return Path(path)


def to_tracks(trajectory: Trajectory, scene: str = "simulated") -> pl.DataFrame:
    """The trajectory in the schema of recordings; a recycled vehicle begins a new track."""
    # Numbers of later tracks lie a whole stride higher, so none is used twice.
    jumps = np.cumsum(trajectory.jumped(), axis=0)
    numbers = np.arange(jumps.shape[1]) + TRACK_STRIDE * jumps
    values = {name: getattr(trajectory, name) for name in ("x", "y", "speed", "length", "width")}
    lane = trajectory.lane()
    return sort(track_table(scene, trajectory.valid, vehicle=numbers, lane=lane, **values))
