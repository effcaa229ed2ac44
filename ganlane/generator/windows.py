"""What is cut from recorded scenes: segments, windows and groups of windows.

A segment is a stretch of a scene with all its vehicles, for joint rollouts; a window is 9 observed
and 8 future positions of one vehicle. Nothing is smoothed: a filter applied before windows are cut
would carry the future into the past.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from sklearn.cluster import KMeans
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from ganlane.data.dense import Recording
from ganlane.errors import UserError
from ganlane.sim.state import Road

#: Observed positions; they give 8 observed displacements (the paper's ``o_l`` = 8).
OBSERVED_POSITIONS = 9
#: Row of the last of them.
PRESENT = OBSERVED_POSITIONS - 1
#: Predicted positions (the paper's ``p_l``): 0.8 s.
PREDICTED_STEPS = 8
#: Frames of a window, 0.1 s apart.
WINDOW_FRAMES = OBSERVED_POSITIONS + PREDICTED_STEPS


@dataclass(frozen=True)
class Segments:
    """B segments of recorded scenes: 9 observed frames and H more, padded to V vehicles.

    Positions go on at constant velocity before a track's first and after its last frame, so they
    are finite everywhere; ``present`` is true where they were recorded.

    Attributes:
        positions: [B, 9 + H, V, 2] float32, m, x relative to the segment's mean at the present.
        present: [B, 9 + H, V] bool, whether a vehicle is recorded.
        target_lane: [B, 9 + H, V] int64, that it keeps or changes to.
        length: [B, V] m.
        lanes: [B, 1] int64, how many the road has.
        lane_width: [B, 1] m.
    """

    positions: Tensor
    present: Tensor
    target_lane: Tensor
    length: Tensor
    lanes: Tensor
    lane_width: Tensor

    @property
    def scored(self) -> Tensor:
        """Vehicles [B, H, V] that count: driven by the model, and still recorded.

        The model drives those that are present in all of the first 9 frames.
        """
        # A vehicle that enters later is shown to the others but not scored.
        observed = self.present[:, :OBSERVED_POSITIONS].all(dim=1, keepdim=True)
        return observed & self.present[:, OBSERVED_POSITIONS:]

    @property
    def future(self) -> Tensor:
        """Recorded positions [B, H, V, 2]."""
        return self.positions[:, OBSERVED_POSITIONS:]

    @property
    def constant_velocity(self) -> Tensor:
        """Positions [B, H, V, 2] when the last observed displacement is repeated."""
        before = self.positions[:, PRESENT - 1, None]
        now = self.positions[:, PRESENT, None]
        # 1 at the first step after the present.
        steps = torch.arange(1, self.positions.shape[1] - PRESENT, dtype=now.dtype)
        return now + (now - before) * steps[:, None, None]

    @property
    def road(self) -> Road:
        """One road per segment."""
        return Road(self.lanes, self.lane_width)

    def repeated(self, times: int) -> Segments:
        """The segments repeated ``times`` times along the batch dimension."""
        copies = [torch.cat([value] * times) for value in vars(self).values()]
        return Segments(*copies)

    def mirrored(self) -> Segments:
        """The segments with left and right swapped."""
        # The leftmost lane becomes lane 0; its centre is then at y = 0.
        last = self.lanes - 1
        leftmost_m = last * self.lane_width

        positions = self.positions.clone()
        positions[..., 1] = leftmost_m[..., None] - positions[..., 1]
        target_lane = last[..., None] - self.target_lane
        return replace(self, positions=positions, target_lane=target_lane)

    def without_intentions(self) -> Segments:
        """The segments with the present lanes as target lanes, for evaluation.

        So no information of the future is used.
        """
        y = self.positions[:, PRESENT, :, 1]
        # The same lanes in all frames.
        lane = self.road.lane_of(y).long()[:, None]
        target_lane = lane.expand_as(self.target_lane).contiguous()
        return replace(self, target_lane=target_lane)


def segment_starts(scene: Recording, horizon: int, stride: int = 1) -> list[int]:
    """Rows where a segment of 9 + ``horizon`` frames with at least one driven vehicle starts.

    Args:
        scene: a recording.
        horizon: frames after the present.
        stride: frames from one row to the next that is tried.
    """
    # Empty for a scene that is shorter than a segment.
    rows = range(0, len(scene.present) - OBSERVED_POSITIONS - horizon + 1, stride)

    starts = []
    for row in rows:
        # Driven are those that are recorded in all observed frames.
        driven = scene.present[row : row + OBSERVED_POSITIONS].all(0)
        if driven.any():
            starts.append(row)
    return starts


def segment_batches(
    scene: Recording,
    horizon: int,
    stride: int,
    size: int,
) -> Iterator[Segments]:
    """All segments of a scene that hold a driven vehicle.

    Args:
        scene: a recording.
        horizon: frames after the present.
        stride: frames between two starts.
        size: how many segments are in a batch; the last one may have fewer.
    """
    cuts = [(scene, row) for row in segment_starts(scene, horizon, stride)]
    for first in range(0, len(cuts), size):
        yield cut_segments(cuts[first : first + size], horizon)


def cut_segments(cuts: list[tuple[Recording, int]], horizon: int) -> Segments:
    """Segments of several scenes, padded to one batch.

    Args:
        cuts: scenes, and the rows where the segments start.
        horizon: frames after the present, the last observed one.
    """
    frames = OBSERVED_POSITIONS + horizon

    members = []
    lengths = []
    for scene, row in cuts:
        # Who is recorded in any frame of a segment is in it.
        recorded = scene.present[row : row + frames].any(0)
        who = np.flatnonzero(recorded)
        members.append(who)
        lengths.append(scene.length[who].astype(np.float32))

    def taken(name: str) -> list[np.ndarray]:
        """A field in the frames of each segment, of its vehicles."""
        fields = []
        for (scene, row), who in zip(cuts, members):
            in_frames = getattr(scene, name)[row : row + frames]
            fields.append(in_frames[:, who])
        return fields

    positions = []
    for places in taken("endless_positions"):
        # Far down the road, float32 loses digits; the lateral zero is the road's.
        middle = np.array([places[PRESENT, :, 0].mean(), 0.0])
        positions.append((places - middle).astype(np.float32))

    lanes = [[scene.lanes] for scene, _ in cuts]
    widths = [[scene.lane_width_m] for scene, _ in cuts]
    return Segments(
        positions=side_by_side(positions),
        present=side_by_side(taken("present")),
        target_lane=side_by_side(taken("target_lane")),
        # Padding has a finite length, as vehicles have.
        length=side_by_side(lengths, filler=1.0),
        lanes=torch.tensor(lanes),
        lane_width=torch.tensor(widths, dtype=torch.float32),
    )


def side_by_side(arrays: Sequence[np.ndarray], filler: float = 0.0) -> Tensor:
    """Arrays of several numbers V of vehicles as one batch, filled up to the widest.

    Args:
        arrays: [T, V, ...] or [V].
        filler: the value of what is filled up.
    """
    # Padding goes along the first dimension, to which that of the vehicles is moved, and back.
    vehicles = min(1, arrays[0].ndim - 1)
    parts = [torch.from_numpy(np.moveaxis(array, vehicles, 0)) for array in arrays]
    batch = pad_sequence(parts, batch_first=True, padding_value=filler)
    return batch.movedim(1, 1 + vehicles).contiguous()


@dataclass(frozen=True)
class Windows:
    """W windows of one vehicle each, ordered by scene, start and vehicle.

    Attributes:
        positions: [W, frames, 2] float64, m.
        scene: [W] str, the scene's name.
        start: [W] int64, row of the scene at which the window starts.
        vehicle: [W] int64, column of its vehicle in the scene.
    """

    positions: np.ndarray
    scene: np.ndarray
    start: np.ndarray
    vehicle: np.ndarray

    def __len__(self) -> int:
        return len(self.start)

    @property
    def future(self) -> np.ndarray:
        """Recorded positions [W, T, 2] after the present, relative to it, m."""
        present = self.positions[:, PRESENT, None]
        return self.positions[:, OBSERVED_POSITIONS:] - present

    @property
    def past(self) -> np.ndarray:
        """Observed displacements [W, 8, 2], m per 0.1 s."""
        return np.diff(self.positions[:, :OBSERVED_POSITIONS], axis=1)


def _present_throughout(scene: Recording, frames: int) -> np.ndarray:
    """Whether each vehicle is present in all ``frames`` that start at a row; bool [rows, V]."""
    # sliding_window_view refuses a window that is longer than the array.
    if len(scene.present) < frames:
        return np.zeros((0, scene.present.shape[1]), dtype=bool)

    # [rows, V, frames]
    windows = sliding_window_view(scene.present, frames, axis=0)
    return np.all(windows, axis=-1)


def count_windows(scene: Recording) -> int:
    """Number of windows of 17 frames in a scene, one per possible start."""
    return int(_present_throughout(scene, WINDOW_FRAMES).sum())


def cut_windows(scenes: list[Recording], stride: int = 1, frames: int = WINDOW_FRAMES) -> Windows:
    """All windows of ``scenes``; none spans two scenes.

    Args:
        scenes: recordings.
        stride: frames between two starts.
        frames: of a window, observed and future ones.

    Raises:
        UserError: no vehicle is present for a whole window.
    """
    parts = []
    for scene in scenes:
        # Row-major order: sorted by start, then by vehicle, as the groups need it.
        whole = _present_throughout(scene, frames)
        start, vehicle = np.nonzero(whole[::stride])
        # From rows of the thinned list back to rows of the scene.
        start *= stride

        # [W, frames, 2]: rows [W, frames] of the scene, and one column [W, 1] per window.
        rows = start[:, None] + np.arange(frames)
        positions = scene.positions[rows, vehicle[:, None]]
        names = np.full(len(start), scene.name)
        parts.append((positions, names, start, vehicle))

    windows = Windows(*map(np.concatenate, zip(*parts)))
    if not len(windows):
        raise UserError(
            f"recordings: no vehicle is present for {frames} frames in a row; "
            "give longer tracks (10 Hz)."
        )
    return windows


@dataclass(frozen=True)
class Groups:
    """B groups of up to G vehicles over the same frames of the same scene, padded.

    Attributes:
        displacements: [B, G, frames - 1, 2] float32, m per 0.1 s.
        position: [B, G, 2] float32, the last observed position relative to the group's mean, m.
        mask: [B, G] bool, false is padding.
        window: [B, G] int64, row in :class:`Windows`; -1 is padding.
    """

    displacements: Tensor
    position: Tensor
    mask: Tensor
    window: Tensor

    def __len__(self) -> int:
        return len(self.mask)

    def select(self, rows: Tensor) -> Groups:
        """The groups of an index ``rows`` [n]."""
        # Vehicles come first, so the columns that only hold padding are the last ones.
        width = int(self.mask[rows].sum(1).max())
        fields = [value[rows, :width] for value in vars(self).values()]
        return Groups(*fields)

    def mirrored(self, flip: Tensor) -> Groups:
        """The same groups, left and right swapped where ``flip`` [B] is true."""
        # Displacements and positions are relative, so a sign mirrors them: factors [B, 1, 2].
        sign = torch.ones(len(self), 1, 2)
        sign[..., 1] = torch.where(flip, -1.0, 1.0)[:, None]
        return replace(
            self,
            displacements=self.displacements * sign[:, :, None],
            position=self.position * sign,
        )


def kmeans_labels(positions: np.ndarray, size: int, seed: int) -> np.ndarray:
    """Group number [n] of each of n positions, by k-means.

    Args:
        positions: [n, 2] in m.
        size: about how many members a group has.
        seed: of the groups' first centres.
    """
    # k-means takes the number of groups; their sizes vary about the wanted one.
    groups = max(1, round(len(positions) / size))
    if groups == 1:
        return np.zeros(len(positions), dtype=np.int64)
    return KMeans(groups, n_init=1, random_state=seed).fit_predict(positions)


def group_windows(windows: Windows, size: int = 9, seed: int = 0) -> Groups:
    """Split the vehicles of every (scene, start) into k-means groups, padded.

    Uses the last observed positions only.

    Args:
        windows: W windows.
        size: about how many vehicles a group has.
        seed: of k-means.
    """
    now = windows.positions[:, PRESENT]

    # Windows are ordered by scene and start, so those of one start are neighbours.
    other_scene = windows.scene[1:] != windows.scene[:-1]
    other_start = np.diff(windows.start) != 0
    begins = np.flatnonzero(other_scene | other_start) + 1

    groups = []
    for rows in np.split(np.arange(len(windows)), begins):
        labels = kmeans_labels(now[rows], size, seed)
        for label in np.unique(labels):
            groups.append(torch.from_numpy(rows[labels == label]))

    # [B, G]; -1 is no row of the windows, while 0 is the first one.
    window = pad_sequence(groups, batch_first=True, padding_value=-1)
    mask = window >= 0

    # Padding is row -1 of the windows, so it has to be masked before the mean is taken.
    place = np.where(mask[..., None], now[window], 0.0)
    members = mask.sum(1).numpy()[:, None, None]
    mean = place.sum(axis=1, keepdims=True) / members
    position = np.where(mask[..., None], place - mean, 0.0)

    moves = np.diff(windows.positions, axis=1)
    displacements = np.where(mask[..., None, None], moves[window], 0.0)
    return Groups(
        displacements=torch.from_numpy(displacements).float(),
        position=torch.from_numpy(position).float(),
        mask=mask,
        window=window,
    )
