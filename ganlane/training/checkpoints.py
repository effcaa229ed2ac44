"""Resume checkpoints: everything a run needs to go on as if it had not been interrupted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from ganlane.errors import UserError
from ganlane.files import atomic_path

KIND = "ganlane training checkpoint"
VERSION = 2
#: Where a run keeps its checkpoint, below its folder.
LAST = Path("checkpoints") / "last.pt"


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain data) atomically."""
    with atomic_path(path) as part:
        torch.save({"kind": KIND, "version": VERSION, "state": state}, part)


def load_checkpoint(path: str | Path, device: torch.device | str = "cpu") -> Any:
    """Read what :func:`save_checkpoint` wrote; never executes code.

    Raises:
        UserError: absent, truncated, or not a training checkpoint of this version.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"resume={path}: no such file; give a run's folder or its {LAST}.")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # foreign bytes can make the unpickler fail in any way
        raise UserError(
            f"resume={path}: not a readable checkpoint (truncated, or not written by ganlane); give another one or "
            "start without resume."
        ) from error
    if not isinstance(content, dict) or content.get("kind") != KIND or content.get("version") != VERSION:
        raise UserError(f"resume={path}: not a {KIND} of version {VERSION}; give a run's {LAST}.")
    return content.get("state")  # whether a run can go on from it, the run knows


def find_checkpoint(resume: str | Path | None, search: str | Path) -> Path | None:
    """The checkpoint that ``resume`` means.

    Args:
        resume: None (start afresh), a checkpoint's path, a run's folder, or ``"auto"``: the newest checkpoint
            anywhere below ``search``, if there is one.
        search: folder of the runs.

    Raises:
        UserError: a path without a checkpoint.
    """
    if resume is None:
        return None
    if resume == "auto":
        found = sorted(Path(search).rglob(str(LAST)), key=lambda path: path.stat().st_mtime)
        return found[-1] if found else None
    path = Path(resume)
    path = path / LAST if path.is_dir() else path
    if not path.is_file():
        raise UserError(f"resume={resume}: no checkpoint there ({path}); give a run's folder, its {LAST}, or auto.")
    return path


def pack(tensordict: TensorDictBase) -> dict[str, Any]:
    """A TensorDict as plain data, nested batch sizes included."""
    leaves = {key: pack(value) if isinstance(value, TensorDictBase) else value for key, value in tensordict.items()}
    return {"batch_size": list(tensordict.batch_size), "items": leaves}


def unpack(packed: dict[str, Any]) -> TensorDict:
    """The TensorDict of :func:`pack`."""
    items = {key: unpack(value) if isinstance(value, dict) else value for key, value in packed["items"].items()}
    return TensorDict(items, batch_size=packed["batch_size"])
