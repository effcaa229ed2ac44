# ruff: noqa: F401  (the names that other parts of the package and users import from here)
"""Recorded traffic: readers of trajectory recordings into one schema, and statistics of driving.

- ``schema`` defines the common form and validates it; ``tables`` reads text tables with errors
  traced to line and column;
- ``sources`` finds recordings;
- readers: ``ngsim``, ``highd``, and ``recordings`` (scene CSV, Parquet, any kind); ``prepared``
  measures recordings and writes them as Parquet;
- measuring: ``lanes`` treats recordings and simulations alike, ``statistics`` combines all
  measurements;
- ``dense`` holds scenes as arrays [frames, tracks], for simulations.
"""

from ganlane.data.lanes import (
    Tracks,
    scene_lane_counts,
    scene_lane_widths,
    tracks_of_frame,
)
from ganlane.data.prepared import PooledStatistics
from ganlane.data.recordings import read_recordings, read_scenes, write_prepared
from ganlane.data.schema import FRAME_S, SCHEMA, TRACK, Scene, sort
from ganlane.data.sources import byte_progress, default_scenes, recordings_path
from ganlane.data.statistics import (
    DrivingStatistics,
    driving_statistics,
    survival_curve,
)
