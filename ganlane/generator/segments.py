"""Recorded scenes as dense arrays, and segments of them, padded to one batch: the start of joint rollouts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import polars as pl
import torch
from torch import Tensor

from ganlane.data import SCHEMA, scene_lane_widths
from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.state import Road

#: Observed positions; they give 8 observed displacements (the paper's ``o_l`` = 8).
OBSERVED_POSITIONS = 9
#: Row of the last of them.
PRESENT = OBSERVED_POSITIONS - 1
#: In fitting, a recorded driver's target lane is its lane after this time, s.
INTENTION_S = 2.0


@dataclass(frozen=True)
class SceneTracks:
    """One recorded scene of T frames (0.1 s apart) and V vehicles; entries of absent vehicles are 0.

    Attributes:
        first_frame: frame number of row 0.
        vehicles: [V] vehicle numbers.
        positions: [T, V, 2] float64, centre of the body, m; x along the road, y to the left.
        lane: [T, V] int64, 0 is the rightmost.
        present: [T, V] bool.
        length, width: [V] float64, m.
    """

    name: str
    lane_width_m: float
    first_frame: int
    vehicles: np.ndarray
    positions: np.ndarray
    lane: np.ndarray
    present: np.ndarray
    length: np.ndarray
    width: np.ndarray

    @property
    def lanes(self) -> int:
        """Number of lanes: the highest lane number plus one."""
        return int(self.lane[self.present].max()) + 1

    @cached_property
    def endless_positions(self) -> np.ndarray:
        """:func:`extrapolate` of the positions."""
        return extrapolate(self.positions, self.present)

    @cached_property
    def target_lane(self) -> np.ndarray:
        """Lane [T, V] that each vehicle will be in after :data:`INTENTION_S`, or at the end of its track."""
        ahead = np.arange(len(self.present))[:, None] + round(INTENTION_S / PHYSICS_STEP_S)
        return np.take_along_axis(self.lane, np.clip(ahead, *_first_and_last(self.present)), axis=0)


def _scene_arrays(name: str, lane_width_m: float, rows: pl.DataFrame) -> SceneTracks:
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
    return SceneTracks(name, lane_width_m, int(frame.min()), vehicles, positions, lane, present, *size)


def scene_tracks(frame: pl.DataFrame) -> list[SceneTracks]:
    """Every scene of a trajectory frame (``ganlane.data``'s schema), in order of their names.

    Raises:
        UserError: a column is missing, there is no row, or lanes are implausibly wide or narrow.
    """
    missing = [name for name in SCHEMA if name not in frame.columns]
    if missing:
        raise UserError(
            f"trajectory frame: columns {missing} are missing; expected {list(SCHEMA)}; "
            "read the recordings with ganlane.data.read_scenes."
        )
    if frame.is_empty():
        raise UserError("trajectory frame: no rows; give recordings of at least 1.7 s.")
    widths = scene_lane_widths(frame)
    return [_scene_arrays(name, widths[name], frame.filter(pl.col("scene") == name)) for name in sorted(widths)]


def extrapolate(positions: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Positions [T, V, 2], each vehicle at constant velocity before its first and after its last present frame."""
    frames, column = np.arange(len(present))[:, None], np.arange(present.shape[1])
    first, last = _first_and_last(present)
    begin, end = positions[first, column], positions[last, column]
    longer = (last > first)[:, None]
    early = np.where(longer, positions[np.minimum(first + 1, last), column] - begin, 0.0)
    late = np.where(longer, end - positions[np.maximum(last - 1, first), column], 0.0)
    before = begin + early * (frames - first)[..., None]
    after = end + late * (frames - last)[..., None]
    inside = np.where(present[..., None], positions, 0.0)
    return np.where((frames < first)[..., None], before, np.where((frames > last)[..., None], after, inside))


def _first_and_last(present: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last present frame of each vehicle, [V] each."""
    return present.argmax(0), len(present) - 1 - present[::-1].argmax(0)


@dataclass(frozen=True)
class Segments:
    """B segments of recorded scenes: 9 observed frames and H more, padded to V vehicles.

    Positions go on at constant velocity before a track's first and after its last frame, so they are finite
    everywhere; ``present`` is true where they were recorded.

    Attributes:
        positions: [B, 9 + H, V, 2] float32, m, x relative to the segment's mean at the present.
        present, target_lane: [B, 9 + H, V], bool and int64.
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
        now, before = self.positions[:, PRESENT, None], self.positions[:, PRESENT - 1, None]
        steps = torch.arange(1, self.positions.shape[1] - PRESENT, dtype=now.dtype)
        return now + (now - before) * steps[:, None, None]

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


def segment_starts(scene: SceneTracks, horizon: int, stride: int = 1) -> list[int]:
    """Rows where a segment of 9 + ``horizon`` frames with at least one driven vehicle starts."""
    rows = range(0, len(scene.present) - OBSERVED_POSITIONS - horizon + 1, stride)
    return [row for row in rows if scene.present[row : row + OBSERVED_POSITIONS].all(0).any()]


def segment_batches(scene: SceneTracks, horizon: int, stride: int, size: int) -> Iterator[Segments]:
    """All segments that start every ``stride`` frames, ``size`` at a time."""
    rows = segment_starts(scene, horizon, stride)
    for first in range(0, len(rows), size):
        yield cut_segments([(scene, row) for row in rows[first : first + size]], horizon)


def cut_segments(cuts: list[tuple[SceneTracks, int]], horizon: int) -> Segments:
    """The segments that start at (scene, row), ``horizon`` steps beyond the present, padded to one batch."""
    parts = [_segment(scene, row, OBSERVED_POSITIONS + horizon) for scene, row in cuts]
    most = max(part["length"].shape[-1] for part in parts)
    batch = {name: torch.stack([_padded(part[name], most, name) for part in parts]) for name in parts[0]}
    lanes = torch.tensor([[scene.lanes] for scene, _ in cuts])
    width = torch.tensor([[scene.lane_width_m] for scene, _ in cuts], dtype=torch.float32)
    return Segments(**batch, lanes=lanes, lane_width=width)


def _segment(scene: SceneTracks, row: int, frames: int) -> dict[str, Tensor]:
    """One segment with the vehicles that are present in it at some time."""
    rows = slice(row, row + frames)
    who = np.flatnonzero(scene.present[rows].any(0))
    positions = scene.endless_positions[rows, who]
    middle = np.array([positions[PRESENT, :, 0].mean(), 0.0])
    return {
        "positions": torch.from_numpy(positions - middle).float(),
        "present": torch.from_numpy(scene.present[rows, who]),
        "target_lane": torch.from_numpy(scene.target_lane[rows, who]),
        "length": torch.from_numpy(scene.length[who]).float(),
        "width": torch.from_numpy(scene.width[who]).float(),
    }


def _padded(value: Tensor, vehicles: int, name: str) -> Tensor:
    """``value`` with the vehicles' dimension padded to ``vehicles`` by zeros (sizes by ones)."""
    behind = (0, 0) if name == "positions" else ()
    missing = vehicles - value.shape[-2 if name == "positions" else -1]
    return torch.nn.functional.pad(value, (*behind, 0, missing), value=name in ("length", "width"))
