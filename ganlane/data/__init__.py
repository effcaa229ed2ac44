"""Recorded traffic: one schema of trajectories, readers into it, and what it says about driving.

Read in this order. ``schema`` is the one form of a recording, and its validator.

**Readers**: ``tables`` (small CSV files, every fault traced to line and column) and ``scenes`` (scene CSV, with
``lane_widths``); ``layout`` and ``blocks`` (text tables of any size); ``ngsim_rows``, ``ngsim_periods``,
``ngsim_checks`` and ``ngsim``; ``highd_meta``, ``highd_directions``, ``resampling`` and ``highd``; ``prepared``
(Parquet). Each hands over the scenes of ``source``. ``find`` knows where recordings lie, ``download`` (with
``part_files``) fetches them, ``synthetic`` makes some up.

**Measuring**: ``tracks`` and ``lane_changes`` (one detector for recordings and simulations), ``following``,
``smoothing``, ``exposure``, ``rates`` and ``distributions`` (what is measured, and how it is summed up),
``lane_change_statistics`` and ``statistics`` (all of it, as plain numbers).

**Preparing**: ``histograms``, ``scene_summary`` and ``pooling`` (statistics scene by scene), ``preparation`` (any
reader to Parquet), ``report`` and ``progress``.
"""

from ganlane.data.distributions import LEVELS, Distribution, Durations, describe, describe_durations, survival_curve
from ganlane.data.download import DownloadParameters, download
from ganlane.data.exposure import Exposure, measure_exposure
from ganlane.data.find import data_folder, default_scenes
from ganlane.data.following import follower_headways, leader_gaps
from ganlane.data.highd import highd_scenes, read_highd
from ganlane.data.histograms import Bins, Histogram
from ganlane.data.lane_change_statistics import LaneChangeStatistics, lane_change_statistics
from ganlane.data.lane_changes import LaneChanges, find_lane_changes, lane_changes_of_arrays, lane_changes_of_frame
from ganlane.data.lane_widths import lane_grid, lane_width, scene_lane_counts, scene_lane_widths
from ganlane.data.ngsim import ngsim_scenes, read_ngsim
from ganlane.data.ngsim_rows import NgsimParameters
from ganlane.data.pooling import PooledStatistics
from ganlane.data.preparation import Preparation, open_scenes, prepare_recordings, read_recordings
from ganlane.data.prepared import cut_into_scenes, read_prepared, write_prepared
from ganlane.data.progress import ByteProgress
from ganlane.data.rates import poisson_interval, srlc, steps_between_changes
from ganlane.data.report import long_report, short_report
from ganlane.data.scene_summary import SceneSummary
from ganlane.data.scenes import read_scenes, scene_csv_scenes
from ganlane.data.schema import FRAME_S, SCHEMA, TRACK_STRIDE, sort, validate
from ganlane.data.smoothing import raw_accelerations, smoothed_accelerations
from ganlane.data.source import RowCount, Scene
from ganlane.data.statistics import DrivingStatistics, driving_statistics
from ganlane.data.synthetic import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.data.tracks import Tracks, tracks_of_arrays, tracks_of_frame

__all__ = [
    "FRAME_S",
    "LEVELS",
    "SCHEMA",
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
    "lane_change_statistics",
    "lane_changes_of_arrays",
    "lane_changes_of_frame",
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
    "read_highd",
    "read_ngsim",
    "read_prepared",
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
