"""Simulated traffic as files that read back like recorded traffic (:func:`ganlane.data.read_scenes`).

Parquet holds the schema (:mod:`ganlane.data.schema`) itself. CSV is the form in which scenes come from elsewhere:
the speed is called ``v``, lanes are counted from the left, from 1, and ``y`` is 0 at the centre of lane 1. It does
not tell how wide the lanes are, and a rightmost lane that nobody drives on does not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import polars as pl

from ganlane.data.scenes import COLUMNS, write_prepared
from ganlane.data.schema import sort
from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.view.trajectory import EpisodeLabel, Trajectory, to_tracks

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
        tables = [scene_csv(to_tracks(each, name), each.label) for each, name in zip(trajectories, names)]
        with atomic_path(path) as part:
            pl.concat(tables).write_csv(part)
    return Path(path)


def scene_names(labels: Sequence[EpisodeLabel]) -> list[str]:
    """A name for each episode's scene, ``AGENT_TRAFFIC_SEED_EPISODE``; a number follows where two would be alike."""
    names: list[str] = []
    for label in labels:
        name = f"{Path(label.agent).stem}_{label.traffic}_{label.seed}_{label.episode}"
        again = sum(other == name or other.startswith(f"{name}-") for other in names)
        names.append(f"{name}-{again + 1}" if again else name)
    return names


def scene_csv(tracks: pl.DataFrame, label: EpisodeLabel) -> pl.DataFrame:
    """Tracks in the schema as a scene CSV's columns, which is what :func:`ganlane.data.read_scenes` turns back."""
    left = (label.lanes - 1) * label.lane_width_m
    turned = tracks.with_columns(v=pl.col("speed"), lane=label.lanes - pl.col("lane"), y=pl.col("y") - left)
    return turned.select(COLUMNS.keys())
