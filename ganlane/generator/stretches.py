"""Stretches of recorded scenes, padded to one batch: what joint rollouts start from and are compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ganlane.generator.tracks import SceneTracks
from ganlane.generator.windows import OBSERVED_POSITIONS, PRESENT
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.road import Road

#: A recorded driver's target lane is the one it will be in after this time (fitting), s.
INTENTION_S = 2.0


@dataclass(frozen=True)
class RolloutScenes:
    """B stretches of recorded scenes: 9 observed frames and H more, padded to V vehicles.

    Positions go on at constant velocity before a track's first and after its last frame, so they are finite
    everywhere; ``present`` tells what was recorded.

    Attributes:
        positions: [B, 9 + H, V, 2] float32, m, x relative to the stretch's mean.
        present: [B, 9 + H, V] bool.
        target_lane: [B, 9 + H, V] int64.
        length, width: [B, V] m.
        lanes, lane_width: [B, 1].
    """

    positions: Tensor
    present: Tensor
    target_lane: Tensor
    length: Tensor
    width: Tensor
    lanes: Tensor
    lane_width: Tensor

    @property
    def driven(self) -> Tensor:
        """Vehicles [B, V] that the model drives: observed in all of the first 9 frames."""
        return self.present[:, :OBSERVED_POSITIONS].all(dim=1)

    @property
    def scored(self) -> Tensor:
        """Driven vehicles [B, H, V] whose recording still goes on."""
        return self.driven[:, None] & self.present[:, OBSERVED_POSITIONS:]

    @property
    def future(self) -> Tensor:
        """Recorded positions [B, H, V, 2]."""
        return self.positions[:, OBSERVED_POSITIONS:]

    @property
    def road(self) -> Road:
        """One road per stretch."""
        return Road(self.lanes, self.lane_width)

    def repeated(self, times: int) -> RolloutScenes:
        """The same stretches ``times`` times over, in the batch's dimension."""
        return RolloutScenes(*(value.repeat(times, *[1] * (value.dim() - 1)) for value in vars(self).values()))

    def mirrored(self) -> RolloutScenes:
        """The same stretches, left and right swapped."""
        positions, last = self.positions.clone(), self.lanes - 1
        positions[..., 1] = (last * self.lane_width)[..., None] - positions[..., 1]
        return replace(self, positions=positions, target_lane=last[..., None] - self.target_lane)

    def without_intentions(self) -> RolloutScenes:
        """Everybody keeps the lane it is in at present: nothing of the future is told (for evaluation)."""
        y = self.positions[:, PRESENT : PRESENT + 1, :, 1]
        lane = Road(self.lanes[..., None], self.lane_width[..., None]).lane_of(y).long()
        return replace(self, target_lane=lane.expand_as(self.target_lane).contiguous())


def extrapolate(positions: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Positions [T, V, 2], each vehicle at constant velocity before its first and after its last present frame."""
    frames = np.arange(len(present))[:, None]
    first, last = present.argmax(0), len(present) - 1 - present[::-1].argmax(0)
    column, longer = np.arange(present.shape[1]), last > first
    begin, end = positions[first, column], positions[last, column]
    early = np.where(longer[:, None], positions[np.minimum(first + 1, last), column] - begin, 0.0)
    late = np.where(longer[:, None], end - positions[np.maximum(last - 1, first), column], 0.0)
    before = begin + early * (frames - first)[..., None]
    after = end + late * (frames - last)[..., None]
    inside = np.where(present[..., None], positions, 0.0)
    return np.where((frames < first)[..., None], before, np.where((frames > last)[..., None], after, inside))


def intended_lanes(scene: SceneTracks) -> np.ndarray:
    """Lane [T, V] that each vehicle will be in after :data:`INTENTION_S`, or at the end of its track."""
    ahead = round(INTENTION_S / PHYSICS_STEP_S)
    frames = np.arange(len(scene.present))[:, None]
    first, last = scene.present.argmax(0), len(scene.present) - 1 - scene.present[::-1].argmax(0)
    return np.take_along_axis(scene.lane, np.clip(frames + ahead, first, last), axis=0)


@dataclass(frozen=True)
class SceneSource:
    """A recorded scene made ready for cutting stretches: no gaps, target lanes known.

    ``rows`` are those at which a stretch may begin.
    """

    scene: SceneTracks
    positions: np.ndarray
    target_lane: np.ndarray
    lanes: int
    lane_width_m: float

    @classmethod
    def of(cls, scene: SceneTracks, lane_width_m: float) -> SceneSource:
        """From tracks, on lanes ``lane_width_m`` wide."""
        lanes = int(scene.lane[scene.present].max()) + 1
        return cls(scene, extrapolate(scene.positions, scene.present), intended_lanes(scene), lanes, lane_width_m)

    def starts(self, horizon: int, stride: int = 1) -> list[int]:
        """Rows at which 9 + ``horizon`` frames begin in which the model has somebody to drive."""
        rows = range(0, len(self.positions) - OBSERVED_POSITIONS - horizon + 1, stride)
        return [row for row in rows if self.scene.present[row : row + OBSERVED_POSITIONS].all(0).any()]


def scene_sources(scenes: list[SceneTracks], lane_widths: dict[str, float]) -> list[SceneSource]:
    """Sources of all ``scenes``; ``lane_widths`` in m by the scenes' names."""
    return [SceneSource.of(scene, lane_widths[scene.name]) for scene in scenes]


def cut_stretches(cuts: list[tuple[SceneSource, int]], horizon: int) -> RolloutScenes:
    """The stretches that begin at (scene, row), ``horizon`` steps beyond the present, padded to one batch."""
    parts = [_stretch(source, row, OBSERVED_POSITIONS + horizon) for source, row in cuts]
    most = max(part["length"].shape[-1] for part in parts)
    batch = {name: torch.stack([_widen(part[name], most, name) for part in parts]) for name in parts[0]}
    lanes = torch.tensor([[source.lanes] for source, _ in cuts])
    width = torch.tensor([[source.lane_width_m] for source, _ in cuts], dtype=torch.float32)
    return RolloutScenes(**batch, lanes=lanes, lane_width=width)


def _stretch(source: SceneSource, row: int, frames: int) -> dict[str, Tensor]:
    """One stretch with the vehicles that are present in it at some time."""
    scene, rows = source.scene, slice(row, row + frames)
    who = np.flatnonzero(scene.present[rows].any(0))
    positions = source.positions[rows, who]
    middle = np.array([positions[PRESENT, :, 0].mean(), 0.0])
    return {
        "positions": torch.from_numpy(positions - middle).float(),
        "present": torch.from_numpy(scene.present[rows, who]),
        "target_lane": torch.from_numpy(source.target_lane[rows, who]),
        "length": torch.from_numpy(scene.length[who]).float(),
        "width": torch.from_numpy(scene.width[who]).float(),
    }


def _widen(value: Tensor, vehicles: int, name: str) -> Tensor:
    """Pad the vehicles' dimension to ``vehicles`` with zeros (sizes with ones)."""
    axis = value.dim() - (2 if name == "positions" else 1)
    shape = list(value.shape)
    shape[axis] = vehicles - shape[axis]
    return torch.cat([value, value.new_full(shape, name in ("length", "width"))], dim=axis)
