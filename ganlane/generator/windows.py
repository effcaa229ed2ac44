"""Windows of 9 observed and 8 future positions, cut from recorded scenes as they were recorded.

Nothing is smoothed: a filter run before windows are cut would carry the future into the past.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ganlane.errors import UserError
from ganlane.generator.tracks import SceneTracks

#: Observed positions; they give 8 observed displacements (the paper's ``o_l`` = 8).
OBSERVED_POSITIONS = 9
#: Row of the last of them.
PRESENT = OBSERVED_POSITIONS - 1
#: Predicted positions (the paper's ``p_l``): 0.8 s.
PREDICTED_STEPS = 8
WINDOW_FRAMES = OBSERVED_POSITIONS + PREDICTED_STEPS


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
    """All windows of ``parts``, whose scenes are different ones, in their order."""
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
    """Whether each vehicle is present throughout the ``frames`` frames from each row on; bool [S, V]."""
    if len(scene.present) < frames:
        return np.zeros((0, scene.present.shape[1]), dtype=bool)
    running = np.concatenate([np.zeros_like(scene.present[:1], dtype=np.int64), scene.present.cumsum(0)])
    return running[frames:] - running[:-frames] == frames


def _cut(scene: SceneTracks, stride: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts and vehicles ([W], [W]) of the scene's windows."""
    start, vehicle = np.nonzero(_whole(scene, frames)[::stride])
    return start * stride, vehicle


def count_windows(scene: SceneTracks, frames: int) -> int:
    """How many windows of ``frames`` frames a scene holds, one from every frame on."""
    return int(_whole(scene, frames).sum())


def cut_windows(scenes: list[SceneTracks], stride: int = 1, frames: int = WINDOW_FRAMES) -> Windows:
    """All windows of ``scenes``, starting at every ``stride``-th frame; a window never spans two scenes.

    Raises:
        UserError: no vehicle is present for a whole window.
    """
    cuts = [_cut(scene, stride, frames) for scene in scenes]
    start, vehicle = (np.concatenate(part) for part in zip(*cuts))
    if not len(start):
        raise UserError(
            f"recordings: no vehicle is present for {frames} frames in a row; give longer tracks (10 Hz)."
        )
    which = np.concatenate([np.full(len(cut[0]), index) for index, cut in enumerate(cuts)])
    gathered = [_gather(scene, *cut, frames) for scene, cut in zip(scenes, cuts)]
    positions, lane, from_left, length = (np.concatenate(part) for part in zip(*gathered))
    names = tuple(scene.name for scene in scenes)
    return Windows(positions, which, start, vehicle, lane, from_left, length, names)


def _gather(scene: SceneTracks, start: np.ndarray, vehicle: np.ndarray, frames: int) -> tuple[np.ndarray, ...]:
    """Positions, lanes from the right and from the left, and lengths of a scene's windows."""
    lane = scene.lane[start + PRESENT, vehicle]
    leftmost = int(scene.lane[scene.present].max())
    positions = scene.positions[start[:, None] + np.arange(frames), vehicle[:, None]]
    return positions, lane, leftmost + 1 - lane, scene.length[vehicle]
