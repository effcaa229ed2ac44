"""Recorded traffic: readers of trajectory recordings into one schema, and statistics of driving.

- ``schema`` defines the common form, validates it, and reads text tables with errors traced to line
  and column;
- ``sources`` finds, fetches or generates recordings;
- readers: ``ngsim``, ``highd``, and ``recordings`` (scene CSV, Parquet, any kind), which also
  prepares Parquet;
- measuring: ``lanes`` treats recordings and simulations alike, ``statistics`` combines all
  measurements.
"""

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
from ganlane.data.recordings import (
    PooledStatistics,
    Preparation,
    SceneSummary,
    prepare_recordings,
    read_recordings,
    read_scenes,
    write_prepared,
    write_scene_csv,
)
from ganlane.data.schema import (
    FRAME_S,
    SCHEMA,
    TRACK,
    TRACK_STRIDE,
    RowCount,
    Scene,
    sort,
    validate,
)
from ganlane.data.sources import (
    SyntheticTraffic,
    byte_progress,
    data_folder,
    default_scenes,
    download,
    recordings_path,
    synthetic_scenes,
)
from ganlane.data.statistics import (
    Bins,
    DrivingStatistics,
    Histogram,
    driving_statistics,
    leader_gaps,
    survival_curve,
)
from ganlane.settings.generator import NgsimParameters

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
    "recordings_path",
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
