"""Recorded and synthetic traffic: one schema of trajectories, readers into it, and what it says about driving."""

from ganlane.data.find import data_folder, default_scenes
from ganlane.data.lane_widths import lane_width, scene_lane_counts, scene_lane_widths
from ganlane.data.scenes import read_scenes
from ganlane.data.schema import FRAME_S, SCHEMA, TRACK_STRIDE, sort, validate
from ganlane.data.synthetic import SyntheticTraffic, synthetic_scenes, write_scene_csv

__all__ = [
    "FRAME_S",
    "SCHEMA",
    "TRACK_STRIDE",
    "SyntheticTraffic",
    "data_folder",
    "default_scenes",
    "lane_width",
    "read_scenes",
    "scene_lane_counts",
    "scene_lane_widths",
    "sort",
    "synthetic_scenes",
    "validate",
    "write_scene_csv",
]
