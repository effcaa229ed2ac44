"""Recorded traffic: one schema of trajectories, readers into it, and what it says about driving.

Read in this order: ``schema`` (the one form of a recording, and its validator), ``scenes`` (the reader of scene
CSV, over ``tables`` and ``lane_widths``), ``find`` (where recordings lie), ``synthetic`` (recordings made up, for
tests and machines without data); then ``tracks`` and ``lane_changes`` (one detector for recordings and
simulations), ``following``, ``smoothing``, ``exposure``, ``rates`` and ``distributions`` (what is measured, and
how it is summed up), ``lane_change_statistics`` and ``statistics`` (all of it, as plain numbers).
"""

from ganlane.data.distributions import LEVELS, Distribution, Durations, describe, describe_durations
from ganlane.data.exposure import Exposure, measure_exposure
from ganlane.data.find import data_folder, default_scenes
from ganlane.data.following import follower_headways, leader_gaps
from ganlane.data.lane_change_statistics import LaneChangeStatistics, lane_change_statistics
from ganlane.data.lane_changes import LaneChanges, find_lane_changes, lane_changes_of_arrays, lane_changes_of_frame
from ganlane.data.lane_widths import lane_width, scene_lane_counts, scene_lane_widths
from ganlane.data.rates import poisson_interval, srlc, steps_between_changes
from ganlane.data.scenes import read_scenes
from ganlane.data.schema import FRAME_S, SCHEMA, TRACK_STRIDE, sort, validate
from ganlane.data.smoothing import raw_accelerations, smoothed_accelerations
from ganlane.data.statistics import DrivingStatistics, driving_statistics
from ganlane.data.synthetic import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.data.tracks import Tracks, tracks_of_arrays, tracks_of_frame

__all__ = [
    "FRAME_S",
    "LEVELS",
    "SCHEMA",
    "TRACK_STRIDE",
    "Distribution",
    "DrivingStatistics",
    "Durations",
    "Exposure",
    "LaneChangeStatistics",
    "LaneChanges",
    "SyntheticTraffic",
    "Tracks",
    "data_folder",
    "default_scenes",
    "describe",
    "describe_durations",
    "driving_statistics",
    "find_lane_changes",
    "follower_headways",
    "lane_change_statistics",
    "lane_changes_of_arrays",
    "lane_changes_of_frame",
    "lane_width",
    "leader_gaps",
    "measure_exposure",
    "poisson_interval",
    "raw_accelerations",
    "read_scenes",
    "scene_lane_counts",
    "scene_lane_widths",
    "smoothed_accelerations",
    "sort",
    "srlc",
    "steps_between_changes",
    "synthetic_scenes",
    "tracks_of_arrays",
    "tracks_of_frame",
    "validate",
    "write_scene_csv",
]
