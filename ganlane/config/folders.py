"""Run folders: their content, the process that uses them, and that a mistake leaves none behind."""

from __future__ import annotations

import itertools
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ganlane.errors import UserError
from ganlane.files import remove_leftovers, write_bytes

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: The command line of a run, in its folder.
OVERRIDES = "overrides.yaml"
CONFIG = "config.yaml"
#: Names the process that is at work in the folder, while it is.
LOCK = ".lock"
#: Files that cost time to make.
EARNED = ("results.json", "agent.safetensors", "last.pt", "fits/*.pt", "generator_*.safetensors")
#: Folders of a run that it writes to itself; others below it may be runs of their own.
_OWN = (".", "checkpoints", "pretrain", "pretrain/checkpoints", "fits")


@contextmanager
def cleared_after_mistakes(folder: Path, existed: bool | None = None) -> Iterator[None]:
    """Remove what a user's mistake leaves of a folder that was not there before, and of the folders above it.

    What a run has earned stays: a folder with results, trained weights or a checkpoint in it is never removed, nor
    one in which another process is at work.

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
        if is_mistake and not existed and not any(any(folder.rglob(name)) for name in (*EARNED, LOCK)):
            shutil.rmtree(folder, ignore_errors=True)
            _remove_empty(made)
        raise


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Work in a run's folder, which no other process may do meanwhile; it is made if need be.

    What killed writes have left there is removed. A run that is refused leaves the command line of the run before
    it. One that ends in an error after it has trained or saved something keeps its own: it can be resumed.

    Raises:
        UserError: another run is at work there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        kept = {name: (folder / name).read_bytes() for name in (OVERRIDES, CONFIG) if (folder / name).is_file()}
        before = earned(folder)
        try:
            yield
        except (UserError, OSError):
            if earned(folder) == before:
                _put_back(folder, kept)
            raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """The folder's lock: the system's, on a file that says who has it; the system frees it when a process dies.

    So a file that a killed run has left stops nobody, whatever process has its number by now. Where the system or the
    folder's file system knows no locks, nobody is stopped either.

    Raises:
        UserError: another run has it.
    """
    path = folder / LOCK
    while True:
        file = path.open("a+", errors="replace")
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            who = file.read().strip() or "another process"
            file.close()
            raise UserError(
                f"{folder}: a run is at work there ({who}); wait for its end, or give another folder."
            ) from error
        except OSError:  # no locks here
            pass
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # who had it before has just removed it
    try:
        for part in _OWN:
            remove_leftovers(folder / part)  # first, since they can be what fills the disk
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


def unused(folder: Path) -> Path:
    """``folder``, or the same name with a number where a run is there already.

    The name holds time and process: two runs of one process within a second would share it.
    """
    names = itertools.chain([folder.name], (f"{folder.name}_{number}" for number in itertools.count(2)))
    return next(folder.with_name(name) for name in names if not (folder.with_name(name) / CONFIG).exists())


def earned(folder: Path) -> set[tuple[Path, int]]:
    """The run's files that cost time to make, with the time of their last change."""
    found = [path for part in _OWN for name in EARNED for path in (folder / part).glob(name)]
    return {(path, path.stat().st_mtime_ns) for path in found}


def _put_back(folder: Path, kept: dict[str, bytes]) -> None:
    """The files that describe a run as they were, those that were not there before away."""
    for name in (OVERRIDES, CONFIG):
        if name in kept:
            write_bytes(folder / name, kept[name])
        else:
            (folder / name).unlink(missing_ok=True)


def _remove_empty(folders: list[Path]) -> None:
    """Remove those of ``folders``, innermost first, that hold nothing."""
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def write_down(composed: Any, asked: list[str], folder: Path) -> None:
    """What was asked for, in the run folder: ``config.yaml`` has all values, ``overrides.yaml`` the command line."""
    from omegaconf import OmegaConf

    write_bytes(folder / CONFIG, OmegaConf.to_yaml(composed, resolve=True).encode())
    write_bytes(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(asked)).encode())
