"""Windows of 9 observed and 8 future positions, cut from recorded scenes as they were recorded.

Nothing is smoothed: a filter run before windows are cut would carry the future into the past.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ganlane.errors import UserError
from ganlane.generator.tracks import SceneTracks

#: Observed positions; they give 8 observed displacements (the paper's ``o_l`` = 8).
OBSERVED_POSITIONS = 9
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
        lane: [W] int64, its lane at the last observed position.
        length: [W] float64, its length, m.
        scene_names: names of the scenes.
    """

    positions: np.ndarray
    scene: np.ndarray
    start: np.ndarray
    vehicle: np.ndarray
    lane: np.ndarray
    length: np.ndarray
    scene_names: tuple[str, ...]


def _cut(scene: SceneTracks, stride: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts and vehicles ([W], [W]) of all windows of ``frames`` frames in which a vehicle is present throughout."""
    if len(scene.present) < frames:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    running = np.concatenate([np.zeros_like(scene.present[:1], dtype=np.int64), scene.present.cumsum(0)])
    whole = running[frames:] - running[:-frames] == frames
    start, vehicle = np.nonzero(whole[::stride])
    return start * stride, vehicle


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
    span, now = np.arange(frames), OBSERVED_POSITIONS - 1
    gathered = [
        (scene.positions[s[:, None] + span, v[:, None]], scene.lane[s + now, v], scene.length[v])
        for scene, (s, v) in zip(scenes, cuts)
    ]
    positions, lane, length = (np.concatenate(part) for part in zip(*gathered))
    return Windows(positions, which, start, vehicle, lane, length, tuple(scene.name for scene in scenes))
