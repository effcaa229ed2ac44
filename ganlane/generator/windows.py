"""Windows of 9 observed and 8 future positions, cut from recorded scenes, and k-means groups of them.

Nothing is smoothed: a filter applied before windows are cut would carry the future into the past. Grouping takes most
of the time before a fit, so it is cached under a hash of everything that it follows from.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import sklearn
import torch
from sklearn.cluster import KMeans
from torch import Tensor

from ganlane.errors import UserError
from ganlane.files import has_checksum, sealed_archive, write_bytes
from ganlane.generator.segments import OBSERVED_POSITIONS, PRESENT, SceneTracks

#: Environment variable with the cache folder; empty switches the cache off.
CACHE_VARIABLE = "GANLANE_CACHE"
#: Predicted positions (the paper's ``p_l``): 0.8 s.
PREDICTED_STEPS = 8
WINDOW_FRAMES = OBSERVED_POSITIONS + PREDICTED_STEPS


@dataclass(frozen=True)
class Windows:
    """W windows of one vehicle each, ordered by scene, start and vehicle.

    Attributes:
        positions: [W, frames, 2] float64, m.
        scene: [W] int64, index into ``scene_names``.
        start, vehicle: [W] int64, row of the scene at which the window starts, and column of its vehicle.
        lane: [W] int64, its lane at the last observed position, 0 the rightmost.
        lane_from_left: [W] int64, the same counted from the scene's leftmost lane, which is 1.
        length: [W] float64, m.
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
    def by_scene(self) -> dict[str, np.ndarray]:
        """Masks [W] of the windows of each scene that has any, by name."""
        numbers = sorted(np.unique(self.scene), key=lambda number: self.scene_names[number])
        return {self.scene_names[number]: self.scene == number for number in numbers}

    @property
    def future(self) -> np.ndarray:
        """Recorded positions [W, T, 2] after the present, relative to it, m."""
        return self.positions[:, OBSERVED_POSITIONS:] - self.positions[:, PRESENT : PRESENT + 1]

    @property
    def past(self) -> np.ndarray:
        """Observed displacements [W, 8, 2], m per 0.1 s."""
        return np.diff(self.positions[:, :OBSERVED_POSITIONS], axis=1)


def join_windows(parts: list[Windows]) -> Windows:
    """All windows of ``parts`` in order; no two parts share a scene."""
    names = tuple(name for part in parts for name in part.scene_names)
    before = np.cumsum([0, *(len(part.scene_names) for part in parts[:-1])])
    joined = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Windows)
        if field.name not in ("scene", "scene_names")
    }
    scene = np.concatenate([part.scene + first for part, first in zip(parts, before)])
    return Windows(**joined, scene=scene, scene_names=names)


def _present_throughout(scene: SceneTracks, frames: int) -> np.ndarray:
    """Whether each vehicle is present in all ``frames`` frames that start at each row; bool [S, V]."""
    if len(scene.present) < frames:
        return np.zeros((0, scene.present.shape[1]), dtype=bool)
    running = np.concatenate([np.zeros_like(scene.present[:1], dtype=np.int64), scene.present.cumsum(0)])
    return running[frames:] - running[:-frames] == frames


def count_windows(scene: SceneTracks) -> int:
    """Number of windows of 17 frames in a scene, one per possible start."""
    return int(_present_throughout(scene, WINDOW_FRAMES).sum())


def cut_windows(scenes: list[SceneTracks], stride: int = 1, frames: int = WINDOW_FRAMES) -> Windows:
    """All windows of ``scenes``, starting at every ``stride``-th frame; a window never spans two scenes.

    Raises:
        UserError: no vehicle is present for a whole window.
    """
    windows = join_windows([_scene_windows(scene, stride, frames) for scene in scenes])
    if not len(windows):
        raise UserError(
            f"recordings: no vehicle is present for {frames} frames in a row; give longer tracks (10 Hz)."
        )
    return windows


def _scene_windows(scene: SceneTracks, stride: int, frames: int) -> Windows:
    start, vehicle = np.nonzero(_present_throughout(scene, frames)[::stride])
    start *= stride
    lane = scene.lane[start + PRESENT, vehicle]
    return Windows(
        positions=scene.positions[start[:, None] + np.arange(frames), vehicle[:, None]],
        scene=np.zeros_like(start),
        start=start,
        vehicle=vehicle,
        lane=lane,
        lane_from_left=scene.lanes - lane,
        length=scene.length[vehicle],
        scene_names=(scene.name,),
    )


def cache_folder() -> Path | None:
    """Folder of the cache: ``GANLANE_CACHE``, else ``ganlane`` in the user's cache folder; None if switched off."""
    named = os.environ.get(CACHE_VARIABLE)
    if named is not None:
        return Path(named) if named else None
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ganlane"


def content_hash(settings: Any, *arrays: np.ndarray) -> str:
    """Hash of plain settings and of the arrays' types, shapes and bytes."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


def cached(name: str, key: str, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays that ``compute`` returns, from the cache if it ran for this ``key`` before.

    A damaged file is computed again, and a folder that cannot be written to is ignored.
    """
    folder = cache_folder()
    if folder is None:
        return compute()
    path = folder / f"{name}_{key}.npz"
    kept = load_arrays(path)
    if kept is not None:
        return kept
    arrays = compute()
    with suppress(OSError):
        save_arrays(path, arrays)
    return arrays


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as .npz with a checksum, atomically."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # numpy's stub takes a name for an option
    write_bytes(path, sealed_archive(file.getvalue()))


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """What :func:`save_arrays` wrote, without pickle; None where it is absent, with a note where damaged."""
    if not path.is_file():
        return None
    of_numpy = (KeyError, EOFError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error)
    with suppress(UserError, OSError, ValueError, *of_numpy):
        content = path.read_bytes()
        if has_checksum(content, path):
            with np.load(io.BytesIO(content), allow_pickle=False) as kept:
                return dict(kept)
    print(f"{path}: damaged or without a checksum; computed again.", file=sys.stderr)
    return None


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
        """The groups of the given rows, without padding that none of them needs."""
        width = int(self.mask[rows].sum(1).max())
        return Groups(*(value[rows, :width] for value in vars(self).values()))

    def mirrored(self, flip: Tensor) -> Groups:
        """The same groups, left and right swapped where ``flip`` [B] is true."""
        sign = torch.ones(len(self), 1, 2)
        sign[..., 1] = torch.where(flip, -1.0, 1.0)[:, None]
        return replace(self, displacements=self.displacements * sign[:, :, None], position=self.position * sign)


def kmeans_labels(positions: np.ndarray, size: int, seed: int) -> np.ndarray:
    """Group number [n] of each of n positions [n, 2], in groups of about ``size``, by k-means on metres."""
    groups = max(1, round(len(positions) / size))
    if groups == 1:
        return np.zeros(len(positions), dtype=np.int64)
    return KMeans(groups, n_init=1, random_state=seed).fit_predict(positions).astype(np.int64)


def group_windows(windows: Windows, size: int = 9, seed: int = 0) -> Groups:
    """Split the vehicles of every (scene, start) into k-means groups of about ``size`` and pad them.

    Uses the last observed positions only; each scene's groups are cached (:func:`cached`).
    """
    now = windows.positions[:, PRESENT]
    settings = {"size": size, "seed": seed, "k-means": sklearn.__version__}

    def labels_of_scene(rows: np.ndarray) -> np.ndarray:
        place, start = now[rows], windows.start[rows]

        def compute() -> dict[str, np.ndarray]:
            return {"labels": _labels_by_run(start, lambda chosen: kmeans_labels(place[chosen], size, seed))}

        return cached("groups", content_hash(settings, place, start), compute)["labels"]

    return _pad(windows, now, _labels_by_run(windows.scene, labels_of_scene))


def _labels_by_run(values: np.ndarray, labels_of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Labels [W] of each run of equal ``values`` [W], by ``labels_of`` its rows; no label is used in two runs."""
    labels, used = np.empty(len(values), dtype=np.int64), 0
    for rows in np.split(np.arange(len(values)), np.flatnonzero(np.diff(values)) + 1):
        labels[rows] = used + labels_of(rows)
        used = int(labels[rows].max()) + 1
    return labels


def _pad(windows: Windows, now: np.ndarray, labels: np.ndarray) -> Groups:
    """Scatter windows into [B, G] by group number and rank within the group."""
    _, labels, counts = np.unique(labels, return_inverse=True, return_counts=True)
    order = np.argsort(labels, kind="stable")
    rank = np.empty(len(labels), dtype=np.int64)
    rank[order] = np.arange(len(labels)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape = (len(counts), int(counts.max()))
    window = np.full(shape, -1)
    window[labels, rank] = np.arange(len(labels))
    mean = np.stack([np.bincount(labels, now[:, axis]) / counts for axis in (0, 1)], axis=-1)
    mask = window >= 0
    displacements = np.where(mask[..., None, None], np.diff(windows.positions, axis=1)[window], 0.0)
    position = np.where(mask[..., None], now[window] - mean[:, None], 0.0)
    return Groups(
        torch.from_numpy(displacements).float(),
        torch.from_numpy(position).float(),
        torch.from_numpy(mask),
        torch.from_numpy(window),
    )
