"""k-means groups of neighbouring vehicles (section III of the paper), padded to one tensor."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import sklearn
import torch
from sklearn.cluster import KMeans
from torch import Tensor

from ganlane.generator.cache import cached, content_hash
from ganlane.generator.windows import PRESENT, Windows


@dataclass(frozen=True)
class Groups:
    """B groups of up to G vehicles over the same frames of the same scene, padded.

    Attributes:
        displacements: [B, G, frames - 1, 2] float32, m per 0.1 s.
        position: [B, G, 2] float32, the last observed position relative to the group's mean, m.
        mask: [B, G] bool, false is padding.
        scene: [B] int64, index of the group's scene.
        window: [B, G] int64, row in :class:`Windows`; -1 is padding.
    """

    displacements: Tensor
    position: Tensor
    mask: Tensor
    scene: Tensor
    window: Tensor

    def __len__(self) -> int:
        return len(self.mask)

    def select(self, rows: Tensor) -> Groups:
        """The groups of the given rows, without padding that none of them needs."""
        width = int(self.mask[rows].sum(1).max())
        chosen = {field.name: getattr(self, field.name)[rows] for field in fields(self)}
        return Groups(**{name: value if value.dim() == 1 else value[:, :width] for name, value in chosen.items()})

    def mirrored(self, flip: Tensor) -> Groups:
        """The same groups, left and right swapped where ``flip`` [B] is true."""
        sign = torch.ones(len(self), 1, 2)
        sign[..., 1] = torch.where(flip, -1.0, 1.0)[:, None]
        return Groups(self.displacements * sign[:, :, None], self.position * sign, self.mask, self.scene, self.window)


def kmeans_labels(positions: np.ndarray, size: int, seed: int) -> np.ndarray:
    """Group number [n] of each of n positions [n, 2], in groups of about ``size``, by k-means on metres."""
    groups = max(1, round(len(positions) / size))
    if groups == 1:
        return np.zeros(len(positions), dtype=np.int64)
    return KMeans(groups, n_init=1, random_state=seed).fit_predict(positions).astype(np.int64)


def group_windows(windows: Windows, size: int = 9, seed: int = 0) -> Groups:
    """Split the vehicles of every (scene, start) into k-means groups of about ``size`` and pad them.

    The split looks at the last observed positions alone, and is the same for the same ``seed``. It takes most of the
    time, so each scene's is kept (:mod:`ganlane.generator.cache`).
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
    )
