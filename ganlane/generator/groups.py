"""k-means groups of neighbouring vehicles (section III of the paper), padded to one tensor, and their cache.

Grouping takes most of the time before a fit, so it is cached under a hash of everything that it follows from: a stale
result is never used.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import sklearn
import torch
from sklearn.cluster import KMeans
from torch import Tensor

from ganlane.files import atomic_path
from ganlane.generator.windows import PRESENT, Windows

#: Environment variable with the cache folder; empty switches the cache off.
VARIABLE = "GANLANE_CACHE"


def cache_folder() -> Path | None:
    """Folder of the cache: ``GANLANE_CACHE``, else ``ganlane`` in the user's cache folder; None if switched off."""
    named = os.environ.get(VARIABLE)
    if named is not None:
        return Path(named) if named else None
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ganlane"


def content_hash(settings: Any, *arrays: np.ndarray) -> str:
    """Hash of plain ``settings`` and of the arrays' types, shapes and bytes."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


def cached(name: str, key: str, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays that ``compute`` returns, from the cache if it ran for this ``key`` before.

    A damaged file is computed again, and a folder that cannot be written to is ignored: the cache never causes a
    wrong result or a failure.
    """
    folder = cache_folder()
    if folder is None:
        return compute()
    path = folder / f"{name}_{key}.npz"
    try:
        with np.load(path, allow_pickle=False) as kept:
            return dict(kept)
    except (OSError, ValueError, zipfile.BadZipFile, KeyError, EOFError):
        arrays = compute()
    try:
        with atomic_path(path) as part, part.open("wb") as file:
            save_arrays(file, arrays)
    except OSError:
        pass
    return arrays


def save_arrays(file: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as .npz; reading them needs no pickle."""
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # numpy's stub takes a name for an option


@dataclass(frozen=True)
class Groups:
    """B groups of up to G vehicles over the same frames of the same scene, padded.

    Attributes:
        displacements: [B, G, frames - 1, 2] float32, m per 0.1 s.
        position: [B, G, 2] float32, the last observed position relative to the group's mean, m.
        mask: [B, G] bool, false is padding.
        scene: [B] int64, index of the group's scene.
        window: [B, G] int64, row in :class:`Windows`; -1 is padding.
        scene_names: names of the scenes.
    """

    displacements: Tensor
    position: Tensor
    mask: Tensor
    scene: Tensor
    window: Tensor
    scene_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.mask)

    def select(self, rows: Tensor) -> Groups:
        """The groups of the given rows, without padding that none of them needs."""
        width = int(self.mask[rows].sum(1).max())
        return replace(
            self,
            displacements=self.displacements[rows, :width],
            position=self.position[rows, :width],
            mask=self.mask[rows, :width],
            scene=self.scene[rows],
            window=self.window[rows, :width],
        )

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

    Uses the last observed positions only, and gives the same groups for the same ``seed``. It takes most of the
    time, so each scene's is cached (:func:`cached`).
    """
    now = windows.positions[:, PRESENT]
    labels, used = np.empty(len(now), dtype=np.int64), 0
    for rows in np.split(np.arange(len(now)), np.flatnonzero(np.diff(windows.scene)) + 1):
        labels[rows] = used + _scene_labels(now[rows], windows.start[rows], size, seed)
        used = int(labels[rows].max()) + 1
    return _pad(windows, now, labels)


def _scene_labels(now: np.ndarray, start: np.ndarray, size: int, seed: int) -> np.ndarray:
    """Group number [W] of every window of one scene."""

    def compute() -> dict[str, np.ndarray]:
        labels, used = np.empty(len(now), dtype=np.int64), 0
        for rows in np.split(np.arange(len(now)), np.flatnonzero(np.diff(start)) + 1):
            labels[rows] = used + kmeans_labels(now[rows], size, seed)
            used = int(labels[rows].max()) + 1
        return {"labels": labels}

    settings = {"size": size, "seed": seed, "k-means": sklearn.__version__}
    return cached("groups", content_hash(settings, now, start), compute)["labels"]


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
    scene = windows.scene[window[:, 0]]
    return Groups(
        torch.from_numpy(displacements).float(),
        torch.from_numpy(position).float(),
        torch.from_numpy(mask),
        torch.from_numpy(scene),
        torch.from_numpy(window),
        windows.scene_names,
    )
