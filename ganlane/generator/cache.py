"""Arrays kept between runs under a hash of what they were computed from, so that nothing stale is ever found."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from ganlane.files import atomic_path

#: Names the folder; empty switches the cache off.
VARIABLE = "GANLANE_CACHE"


def cache_folder() -> Path | None:
    """Where arrays are kept: ``GANLANE_CACHE``, else ``ganlane`` in the user's cache folder; None is nowhere."""
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
    """The arrays that ``compute`` gives, from the cache if it ran for this ``key`` before.

    A damaged file is computed again, and a folder that cannot be written to is done without: a cache may be slow,
    but it must not be wrong and must not stop anybody.
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
