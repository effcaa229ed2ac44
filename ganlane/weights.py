"""Weights as safetensors files, which cannot execute code, with plain metadata and a checksum."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load

from ganlane.errors import UserError
from ganlane.files import (
    PLACE,
    has_checksum,
    read_whole,
    refuse_without_checksum,
    sealed,
    write_bytes,
)

if TYPE_CHECKING:
    from torch import Tensor


def save_weights(
    path: str | Path, kind: str, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]
) -> None:
    """Save ``tensors`` and plain ``metadata`` as safetensors, atomically.

    Args:
        path: where to write.
        kind: what the file holds (``"agent"``, ``"generator"``); :func:`load_weights` checks it.
        tensors: flat name to tensor.
        metadata: JSON-serialisable description (config, data, metrics, code version).
    """
    from safetensors.torch import save  # torch takes seconds, and the kernel needs none

    # On the CPU: a file from a GPU must load anywhere.
    flat = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = {
        "ganlane": json.dumps({"kind": kind, **metadata}),
        "checksum": PLACE,
    }
    write_bytes(path, sealed(save(flat, metadata=header)))


def load_weights(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What :func:`load_arrays` reads, as tensors."""
    import torch  # takes seconds

    arrays, metadata = load_arrays(path, kind)
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    return tensors, metadata


def load_arrays(path: str | Path, kind: str) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Load what :func:`save_weights` wrote: ``(arrays, metadata)``, without torch.

    Raises:
        UserError: the file is absent, damaged, not safetensors, not written by ganlane, of another
            kind, or holds numbers that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(
            f"{path}: no such file; a checkpoint of kind {kind} (.safetensors) was expected there."
        )
    content = read_whole(path)
    whole = has_checksum(content, path)
    try:
        arrays = load(content)
        # The format begins with the header's length and the header, JSON. The library's reader of
        # bytes leaves the metadata out.
        end = 8 + int.from_bytes(content[:8], "little")
        header = json.loads(content[8:end]).get("__metadata__") or {}
        metadata = json.loads(header.get("ganlane", "{}"))
    # KeyError: a number type that NumPy lacks
    except (SafetensorError, ValueError, KeyError, RecursionError) as error:
        raise UserError(
            f"{path}: not a readable safetensors file ({error}); "
            f"give a checkpoint of kind {kind} that ganlane wrote."
        ) from error

    stored = metadata.get("kind") if isinstance(metadata, dict) else None
    if stored != kind:
        raise UserError(
            f"{path}: expected a ganlane checkpoint of kind {kind}, found "
            f"{stored or 'a file that ganlane did not write'}; give one that ganlane wrote."
        )

    # NaN would drive without a word.
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise UserError(
                f"{path}: {name} holds numbers that are not finite; train or fit it again."
            )

    # Last, so that a file that ganlane did not write is refused as such.
    if not whole:
        refuse_without_checksum(path)
    return arrays, metadata
