"""Run folders: what stands in each, and that a mistake leaves none behind."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ganlane.errors import UserError

#: The command line of a run, in its folder.
OVERRIDES = "overrides.yaml"
CONFIG = "config.yaml"
#: Files that cost time to make.
EARNED = ("results.json", "agent.safetensors", "last.pt", "fits/*.pt", "generator_*.safetensors")


@contextmanager
def cleared_after_mistakes(folder: Path, existed: bool | None = None) -> Iterator[None]:
    """Remove what a user's mistake leaves of a folder that was not there before, and of the folders above it.

    What a run has earned stays: a folder with results, trained weights or a checkpoint in it is never removed.

    Args:
        folder: the run's or the sweep's.
        existed: whether it held something before; by default, whether it is there now.
    """
    existed = folder.exists() if existed is None else existed
    made = [parent for parent in folder.parents if not parent.exists()]
    try:
        yield
    except BaseException as error:
        is_mistake = isinstance(error, UserError | OSError)
        if is_mistake and not existed and not any(any(folder.rglob(name)) for name in EARNED):
            shutil.rmtree(folder, ignore_errors=True)
            _remove_empty(made)
        raise


@contextmanager
def put_back_after_mistakes(folder: Path) -> Iterator[None]:
    """Give a resumed run its command line back where going on with another one was refused."""
    kept = {name: (folder / name).read_bytes() for name in (OVERRIDES, CONFIG) if (folder / name).is_file()}
    try:
        yield
    except (UserError, OSError):
        from ganlane.files import write_bytes

        for name in (OVERRIDES, CONFIG):
            if name in kept:
                write_bytes(folder / name, kept[name])
            else:
                (folder / name).unlink(missing_ok=True)
        raise


def _remove_empty(folders: list[Path]) -> None:
    """Remove those of ``folders``, innermost first, that hold nothing."""
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def write_down(composed: Any, asked: list[str], folder: Path) -> None:
    """What was asked for, in the run folder: ``config.yaml`` has all values, ``overrides.yaml`` the command line."""
    from omegaconf import OmegaConf

    from ganlane.files import write_bytes

    write_bytes(folder / CONFIG, OmegaConf.to_yaml(composed, resolve=True).encode())
    write_bytes(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(asked)).encode())
