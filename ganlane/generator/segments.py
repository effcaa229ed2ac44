"""Segments of recorded scenes, padded to one batch: the start of joint rollouts and what they are compared with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ganlane.generator.windows import OBSERVED_POSITIONS, PRESENT, SceneTracks
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.state import Road

#: In fitting, a recorded driver's target lane is its lane after this time, s.
INTENTION_S = 2.0


def constant_velocity(displacement: Tensor, steps: int) -> Tensor:
    """Positions [..., steps, 2] in m relative to the present when ``displacement`` [..., 2] per 0.1 s is repeated."""
    return displacement[..., None, :] * torch.arange(1, steps + 1, dtype=displacement.dtype)[:, None]


@dataclass(frozen=True)
class Segments:
    """B segments of recorded scenes: 9 observed frames and H more, padded to V vehicles.

    Positions go on at constant velocity before a track's first and after its last frame, so they are finite
    everywhere; ``present`` is true where they were recorded.

    Attributes:
        positions: [B, 9 + H, V, 2] float32, m, x relative to the segment's mean at the present.
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
        """Vehicles [B, V] that the model drives: present in all of the first 9 frames."""
        return self.present[:, :OBSERVED_POSITIONS].all(dim=1)

    @property
    def scored(self) -> Tensor:
        """Driven vehicles [B, H, V] that are still recorded."""
        return self.driven[:, None] & self.present[:, OBSERVED_POSITIONS:]

    @property
    def future(self) -> Tensor:
        """Recorded positions [B, H, V, 2]."""
        return self.positions[:, OBSERVED_POSITIONS:]

    @property
    def constant_velocity(self) -> Tensor:
        """Positions [B, H, V, 2] when the last observed displacement is repeated."""
        now, before = self.positions[:, PRESENT], self.positions[:, PRESENT - 1]
        ahead = constant_velocity(now - before, self.positions.shape[1] - OBSERVED_POSITIONS)
        return now[:, None] + ahead.transpose(1, 2)

    @property
    def road(self) -> Road:
        """One road per segment."""
        return Road(self.lanes, self.lane_width)

    def repeated(self, times: int) -> Segments:
        """The segments repeated ``times`` times along the batch dimension."""
        return Segments(*(value.repeat(times, *[1] * (value.dim() - 1)) for value in vars(self).values()))

    def mirrored(self) -> Segments:
        """The segments with left and right swapped."""
        positions, last = self.positions.clone(), self.lanes - 1
        positions[..., 1] = (last * self.lane_width)[..., None] - positions[..., 1]
        return replace(self, positions=positions, target_lane=last[..., None] - self.target_lane)

    def without_intentions(self) -> Segments:
        """Target lanes are the present ones, so that no information of the future is used (for evaluation)."""
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
class SegmentSource:
    """A recorded scene from which segments are cut: positions extrapolated, target lanes known."""

    scene: SceneTracks
    positions: np.ndarray
    target_lane: np.ndarray
    lanes: int
    lane_width_m: float

    def starts(self, horizon: int, stride: int = 1) -> list[int]:
        """Rows where a segment of 9 + ``horizon`` frames with at least one driven vehicle starts."""
        rows = range(0, len(self.positions) - OBSERVED_POSITIONS - horizon + 1, stride)
        return [row for row in rows if self.scene.present[row : row + OBSERVED_POSITIONS].all(0).any()]

    def batches(self, horizon: int, stride: int, size: int) -> Iterator[Segments]:
        """All segments that start every ``stride`` frames, ``size`` at a time."""
        rows = self.starts(horizon, stride)
        for first in range(0, len(rows), size):
            yield cut_segments([(self, row) for row in rows[first : first + size]], horizon)


def segment_sources(scenes: list[SceneTracks], lane_widths: dict[str, float]) -> list[SegmentSource]:
    """Sources of all ``scenes``; ``lane_widths`` in m by the scenes' names."""
    return [
        SegmentSource(
            scene=scene,
            positions=extrapolate(scene.positions, scene.present),
            target_lane=intended_lanes(scene),
            lanes=int(scene.lane[scene.present].max()) + 1,
            lane_width_m=lane_widths[scene.name],
        )
        for scene in scenes
    ]


def cut_segments(cuts: list[tuple[SegmentSource, int]], horizon: int) -> Segments:
    """The segments that start at (scene, row), ``horizon`` steps beyond the present, padded to one batch."""
    parts = [_segment(source, row, OBSERVED_POSITIONS + horizon) for source, row in cuts]
    most = max(part["length"].shape[-1] for part in parts)
    batch = {name: torch.stack([_widen(part[name], most, name) for part in parts]) for name in parts[0]}
    lanes = torch.tensor([[source.lanes] for source, _ in cuts])
    width = torch.tensor([[source.lane_width_m] for source, _ in cuts], dtype=torch.float32)
    return Segments(**batch, lanes=lanes, lane_width=width)


def _segment(source: SegmentSource, row: int, frames: int) -> dict[str, Tensor]:
    """One segment with the vehicles that are present in it at some time."""
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
