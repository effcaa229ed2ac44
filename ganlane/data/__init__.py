"""Recorded traffic: readers of trajectory recordings into one schema, and statistics of driving.

**The schema**: ``schema`` defines and validates it.

**Readers**: ``scenes`` (scene CSV and Parquet, with ``lane_widths``), ``ngsim`` and ``highd``, all based on
``tables`` (text tables with errors traced to line and column). ``find`` locates the recordings, ``download``
fetches them, and ``synthetic`` generates some.

**Measuring**: ``tracks`` (tracks as arrays) and ``lane_changes`` treat recordings and simulations alike;
``distributions`` summarises samples, ``statistics`` combines all measurements.

**Preparing**: ``prepare`` turns any recording into Parquet and pooled statistics, ``report`` formats the result.
"""

from ganlane.data.distributions import (
    LEVELS,
    Bins,
    Distribution,
    Durations,
    Histogram,
    describe,
    describe_durations,
    survival_curve,
)
from ganlane.data.download import ByteProgress, DownloadParameters, download
from ganlane.data.find import data_folder, default_scenes
from ganlane.data.highd import highd_scenes
from ganlane.data.lane_changes import LaneChanges, find_lane_changes, lane_changes_of_arrays
from ganlane.data.lane_widths import lane_grid, lane_width, scene_lane_counts, scene_lane_widths
from ganlane.data.ngsim import ngsim_scenes
from ganlane.data.prepare import (
    PooledStatistics,
    Preparation,
    SceneSummary,
    open_scenes,
    prepare_recordings,
    read_recordings,
)
from ganlane.data.report import long_report, short_report
from ganlane.data.scenes import cut_into_scenes, read_scenes, scene_csv_scenes, write_prepared
from ganlane.data.schema import FRAME_S, SCHEMA, TRACK, TRACK_STRIDE, RowCount, Scene, sort, validate
from ganlane.data.statistics import (
    DrivingStatistics,
    Exposure,
    LaneChangeStatistics,
    driving_statistics,
    follower_headways,
    leader_gaps,
    measure_exposure,
    poisson_interval,
    raw_accelerations,
    smoothed_accelerations,
    srlc,
    steps_between_changes,
)
from ganlane.data.synthetic import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.data.tracks import Tracks, tracks_of_arrays, tracks_of_frame
from ganlane.parameters.data import NgsimParameters

__all__ = [
    "FRAME_S",
    "LEVELS",
    "SCHEMA",
    "TRACK",
    "TRACK_STRIDE",
    "Bins",
    "ByteProgress",
    "Distribution",
    "DownloadParameters",
    "DrivingStatistics",
    "Durations",
    "Exposure",
    "Histogram",
    "LaneChangeStatistics",
    "LaneChanges",
    "NgsimParameters",
    "PooledStatistics",
    "Preparation",
    "RowCount",
    "Scene",
    "SceneSummary",
    "SyntheticTraffic",
    "Tracks",
    "cut_into_scenes",
    "data_folder",
    "default_scenes",
    "describe",
    "describe_durations",
    "download",
    "driving_statistics",
    "find_lane_changes",
    "follower_headways",
    "highd_scenes",
    "lane_changes_of_arrays",
    "lane_grid",
    "lane_width",
    "leader_gaps",
    "long_report",
    "measure_exposure",
    "ngsim_scenes",
    "open_scenes",
    "poisson_interval",
    "prepare_recordings",
    "raw_accelerations",
    "read_recordings",
    "read_scenes",
    "scene_csv_scenes",
    "scene_lane_counts",
    "scene_lane_widths",
    "short_report",
    "smoothed_accelerations",
    "sort",
    "srlc",
    "steps_between_changes",
    "survival_curve",
    "synthetic_scenes",
    "tracks_of_arrays",
    "tracks_of_frame",
    "validate",
    "write_prepared",
    "write_scene_csv",
]
