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

    Args:
        trajectories: the recorded episodes, one or more.
        path: file to write.

    Returns:
        The path.
    """
    # The same driver, traffic, seed and episode may come twice; scenes need names of their own.
    times = Counter[str]()
    tables = []
    for trajectory in trajectories:
        label = trajectory.label
        name = f"{Path(label.agent).stem}_{label.traffic}_{label.seed}_{label.episode}"
        times[name] += 1
        scene = name if times[name] == 1 else f"{name}-{times[name]}"
        tables.append(to_tracks(trajectory, scene))
    write_prepared(sort(pl.concat(tables)), path)
    return Path(path)


def to_tracks(trajectory: Trajectory, scene: str = "simulated") -> pl.DataFrame:
    """The trajectory in the schema of recordings, as a scene of this name.

    A recycled vehicle begins a new track.
    """
    # Numbers of later tracks lie a whole stride higher, so none is used twice; [T, M].
    jumps = np.cumsum(trajectory.jumped(), axis=0)
    numbers = np.arange(jumps.shape[1]) + TRACK_STRIDE * jumps
    table = track_table(
        scene,
        trajectory.valid,
        vehicle=numbers,
        x=trajectory.x,
        y=trajectory.y,
        speed=trajectory.speed,
        lane=trajectory.lane(),
        length=trajectory.length,
        width=trajectory.width,
    )
    return sort(table)
