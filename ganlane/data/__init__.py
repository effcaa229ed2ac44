"""Recorded traffic: readers of trajectory recordings into one schema, and statistics of driving.

- ``schema`` defines the common form and validates it;
- readers: ``scenes`` (scene CSV and Parquet), ``ngsim`` and ``highd``, all based on ``tables``
  (text tables with errors traced to line and column);
- ``download`` finds or fetches recordings, ``synthetic`` generates some;
- measuring: ``lanes`` treats recordings and simulations alike, ``statistics`` combines all measurements;
- ``prepare`` turns any recording into Parquet and pooled statistics.
"""

from ganlane.data.download import byte_progress, data_folder, default_scenes, download
from ganlane.data.highd import highd_scenes
from ganlane.data.lanes import (
    Tracks,
    find_lane_changes,
    lane_changes_of_arrays,
    scene_lane_counts,
    scene_lane_widths,
    tracks_of_frame,
)
from ganlane.data.ngsim import ngsim_scenes
from ganlane.data.prepare import PooledStatistics, Preparation, SceneSummary, prepare_recordings, read_recordings
from ganlane.data.scenes import read_scenes, write_prepared, write_scene_csv
from ganlane.data.schema import FRAME_S, SCHEMA, TRACK, TRACK_STRIDE, RowCount, Scene, sort, validate
from ganlane.data.statistics import (
    Bins,
    DrivingStatistics,
    Histogram,
    driving_statistics,
    leader_gaps,
    survival_curve,
)
from ganlane.data.synthetic import SyntheticTraffic, synthetic_scenes
from ganlane.parameters.generator import NgsimParameters

__all__ = [
    "FRAME_S",
    "SCHEMA",
    "TRACK",
    "TRACK_STRIDE",
    "Bins",
    "DrivingStatistics",
    "Histogram",
    "NgsimParameters",
    "PooledStatistics",
    "Preparation",
    "RowCount",
    "Scene",
    "SceneSummary",
    "SyntheticTraffic",
    "Tracks",
    "byte_progress",
    "data_folder",
    "default_scenes",
    "download",
    "driving_statistics",
    "find_lane_changes",
    "highd_scenes",
    "lane_changes_of_arrays",
    "leader_gaps",
    "ngsim_scenes",
    "prepare_recordings",
    "read_recordings",
    "read_scenes",
    "scene_lane_counts",
    "scene_lane_widths",
    "sort",
    "survival_curve",
    "synthetic_scenes",
    "tracks_of_frame",
    "validate",
    "write_prepared",
    "write_scene_csv",
]
