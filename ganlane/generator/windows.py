"""Recorded scenes as dense arrays, and the windows of 9 observed and 8 future positions that are cut from them.

Nothing is smoothed: a filter applied before windows are cut would carry the future into the past.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import polars as pl

from ganlane.errors import UserError

REQUIRED_COLUMNS = ("scene", "vehicle", "frame", "x", "y", "speed", "lane", "length", "width")
#: Observed positions; they give 8 observed displacements (the paper's ``o_l`` = 8).
OBSERVED_POSITIONS = 9
#: Row of the last of them.
PRESENT = OBSERVED_POSITIONS - 1
#: Predicted positions (the paper's ``p_l``): 0.8 s.
PREDICTED_STEPS = 8
WINDOW_FRAMES = OBSERVED_POSITIONS + PREDICTED_STEPS


@dataclass(frozen=True)
class SceneTracks:
    """One recorded scene of T frames (0.1 s apart) and V vehicles; entries of absent vehicles are 0.

    Attributes:
        name: the scene's name.
        first_frame: frame number of row 0.
        vehicles: [V] vehicle numbers.
        positions: [T, V, 2] float64, centre of the body, m; x along the road, y to the left.
        lane: [T, V] int64, 0 is the rightmost.
        present: [T, V] bool.
        length, width: [V] float64, m.
    """

    name: str
    first_frame: int
    vehicles: np.ndarray
    positions: np.ndarray
    lane: np.ndarray
    present: np.ndarray
    length: np.ndarray
    width: np.ndarray


def _one_scene(name: str, rows: pl.DataFrame) -> SceneTracks:
    vehicles, column = np.unique(rows["vehicle"].to_numpy(), return_inverse=True)
    frame = rows["frame"].to_numpy()
    row = frame - frame.min()
    shape = (int(row.max()) + 1, len(vehicles))
    positions, lane = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.int64)
    present, size = np.zeros(shape, dtype=bool), np.zeros((2, len(vehicles)))
    positions[row, column] = rows.select("x", "y").to_numpy()
    lane[row, column] = rows["lane"].to_numpy()
    present[row, column] = True
    size[:, column] = rows.select("length", "width").to_numpy().T
    return SceneTracks(name, int(frame.min()), vehicles, positions, lane, present, size[0], size[1])


def scene_tracks(frame: pl.DataFrame) -> list[SceneTracks]:
    """Every scene of a trajectory frame (``ganlane.data``'s schema), in order of their names.

    Raises:
        UserError: a column is missing, or there is no row.
    """
    missing = [name for name in REQUIRED_COLUMNS if name not in frame.columns]
    if missing:
        raise UserError(
            f"trajectory frame: columns {missing} are missing; expected {list(REQUIRED_COLUMNS)}; "
            "read the recordings with ganlane.data.read_scenes."
        )
    if frame.is_empty():
        raise UserError("trajectory frame: no rows; give recordings of at least 1.7 s.")
    names = sorted(frame["scene"].unique().to_list())
    return [_one_scene(name, frame.filter(pl.col("scene") == name)) for name in names]


@dataclass(frozen=True)
class Windows:
    """W windows of one vehicle each, ordered by scene, start and vehicle.

    Attributes:
        positions: [W, frames, 2] float64, m.
        scene: [W] int64, index into ``scene_names``.
        start: [W] int64, row of the scene at which the window starts.
        vehicle: [W] int64, column of the vehicle in the scene.
        lane: [W] int64, its lane at the last observed position, 0 the rightmost.
        lane_from_left: [W] int64, the same counted from the scene's leftmost lane, which is 1.
        length: [W] float64, its length, m.
        scene_names: names of the scenes.
    """

    positions: np.ndarray
    scene: np.ndarray
    start: np.ndarray
    vehicle: np.ndarray
    lane: np.ndarray
    lane_from_left: np.ndarray
    length: np.ndarray
    scene_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.start)

    @property
    def future(self) -> np.ndarray:
        """Recorded positions [W, T, 2] after the present, relative to it, m."""
        return self.positions[:, OBSERVED_POSITIONS:] - self.positions[:, PRESENT : PRESENT + 1]

    @property
    def past(self) -> np.ndarray:
        """Observed displacements [W, 8, 2], m per 0.1 s."""
        return np.diff(self.positions[:, :OBSERVED_POSITIONS], axis=1)


def join_windows(parts: list[Windows]) -> Windows:
    """All windows of ``parts`` in order; no scene is in two parts."""
    names = tuple(name for part in parts for name in part.scene_names)
    before = np.cumsum([0, *(len(part.scene_names) for part in parts[:-1])])
    joined = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Windows)
        if field.name not in ("scene", "scene_names")
    }
    scene = np.concatenate([part.scene + first for part, first in zip(parts, before)])
    return Windows(**joined, scene=scene, scene_names=names)


def _whole(scene: SceneTracks, frames: int) -> np.ndarray:
    """Whether each vehicle is present in all ``frames`` frames that start at each row; bool [S, V]."""
    if len(scene.present) < frames:
        return np.zeros((0, scene.present.shape[1]), dtype=bool)
    running = np.concatenate([np.zeros_like(scene.present[:1], dtype=np.int64), scene.present.cumsum(0)])
    return running[frames:] - running[:-frames] == frames


def _cut(scene: SceneTracks, stride: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts and vehicles ([W], [W]) of the scene's windows."""
    start, vehicle = np.nonzero(_whole(scene, frames)[::stride])
    return start * stride, vehicle


def count_windows(scene: SceneTracks, frames: int) -> int:
    """Number of windows of ``frames`` frames in a scene, one per possible start."""
    return int(_whole(scene, frames).sum())


def cut_windows(scenes: list[SceneTracks], stride: int = 1, frames: int = WINDOW_FRAMES) -> Windows:
    """All windows of ``scenes``, starting at every ``stride``-th frame; a window never spans two scenes.

    Raises:
        UserError: no vehicle is present for a whole window.
    """
    cuts = [_cut(tracks, stride, frames) for tracks in scenes]
    start, vehicle = (np.concatenate(part) for part in zip(*cuts))
    if not len(start):
        raise UserError(
            f"recordings: no vehicle is present for {frames} frames in a row; give longer tracks (10 Hz)."
        )
    scene = np.concatenate([np.full(len(cut[0]), index) for index, cut in enumerate(cuts)])
    gathered = [_gather(tracks, *cut, frames) for tracks, cut in zip(scenes, cuts)]
    positions, lane, from_left, length = (np.concatenate(part) for part in zip(*gathered))
    names = tuple(tracks.name for tracks in scenes)
    return Windows(positions, scene, start, vehicle, lane, from_left, length, names)


def _gather(scene: SceneTracks, start: np.ndarray, vehicle: np.ndarray, frames: int) -> tuple[np.ndarray, ...]:
    """Positions, lanes from the right and from the left, and lengths of a scene's windows."""
    lane = scene.lane[start + PRESENT, vehicle]
    leftmost = int(scene.lane[scene.present].max())
    positions = scene.positions[start[:, None] + np.arange(frames), vehicle[:, None]]
    return positions, lane, leftmost + 1 - lane, scene.length[vehicle]
