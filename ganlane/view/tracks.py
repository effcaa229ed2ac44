"""Simulated traffic in the form of recorded traffic, and files that :func:`ganlane.data.read_scenes` reads back.

Parquet holds the schema (:mod:`ganlane.data.schema`) itself. In CSV, the form of recordings from elsewhere, the speed
is called ``v``, lanes are counted from the left, from 1, and ``y`` is 0 at the centre of lane 1. It has no lane
width, and a rightmost lane without vehicles is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl

from ganlane import keys
from ganlane.data.recordings import scene_csv, write_prepared
from ganlane.data.schema import SCHEMA, TRACK_STRIDE, sort
from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.view.record import EpisodeLabel, Trajectory

TracksFormat = Literal["csv", "parquet"]


def write_tracks(trajectories: Sequence[Trajectory], path: str | Path, format: TracksFormat) -> Path:
    """Write recorded episodes, a scene each, atomically.

    Args:
        trajectories: recorded at every physics step.
        path: where to write.
        format: ``csv`` or ``parquet``.

    Raises:
        UserError: there is no episode, or one whose frames are not 0.1 s apart.
    """
    if not trajectories:
        raise UserError(f"format={format}: no episode to write; record at least one.")
    names = scene_names([each.label for each in trajectories])
    if format == "parquet":
        write_prepared(sort(pl.concat([to_tracks(each, name) for each, name in zip(trajectories, names)])), path)
    else:
        tables = [
            scene_csv(to_tracks(each, name), pl.lit(each.label.lanes - 1), each.label.lane_width_m)
            for each, name in zip(trajectories, names)
        ]
        with atomic_path(path) as part:
            pl.concat(tables).write_csv(part)
    return Path(path)


def to_tracks(trajectory: Trajectory, scene: str = "simulated") -> pl.DataFrame:
    """The trajectory as a table in the schema of recordings; a recycled vehicle begins a new track.

    Raises:
        UserError: the frames are not 0.1 s apart.
    """
    if len(trajectory) > 1 and abs(trajectory.frame_s - keys.PHYSICS_STEP_S) > 1e-6:
        raise UserError(
            f"trajectory: its frames are {trajectory.frame_s:g} s apart, tracks need {keys.PHYSICS_STEP_S} s; "
            "record it at every physics step."
        )
    frames, vehicles = trajectory.x.shape
    track = np.arange(vehicles) + TRACK_STRIDE * np.cumsum(trajectory.jumped(), axis=0)
    columns = {
        "vehicle": track,
        "frame": np.broadcast_to(np.arange(frames)[:, None], (frames, vehicles)),
        **{name: getattr(trajectory, name) for name in ("x", "y", "speed", "length", "width")},
        "lane": trajectory.lane(),
    }
    shown = trajectory.valid
    table = pl.DataFrame({"scene": [scene] * int(shown.sum()), **{k: v[shown] for k, v in columns.items()}})
    return table.select(pl.col(name).cast(kind) for name, kind in SCHEMA.items()).sort("scene", "vehicle", "frame")


def scene_names(labels: Sequence[EpisodeLabel]) -> list[str]:
    """A name for each episode's scene, ``AGENT_TRAFFIC_SEED_EPISODE``; a number follows where two would be alike."""
    names: list[str] = []
    for label in labels:
        name = f"{Path(label.agent).stem}_{label.traffic}_{label.seed}_{label.episode}"
        again = sum(other == name or other.startswith(f"{name}-") for other in names)
        names.append(f"{name}-{again + 1}" if again else name)
    return names
