"""Run folders: their content, their lock, and their removal after a user's mistake."""

from __future__ import annotations

import itertools
import os
import shlex
import shutil
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from ganlane.errors import UserError
from ganlane.files import remove_leftovers, write_bytes

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: File in the run folder with the run's command line.
OVERRIDES = "overrides.yaml"
CONFIG = "config.yaml"
#: File that names the process that uses the folder.
LOCK = ".lock"
#: Files that took time to make.
EARNED = ("results.json", "agent.safetensors", "last.pt", "fits/*.pt", "generator_*.safetensors")
#: Folders of a run that it writes to itself; others below it may be runs of their own.
_OWN = (".", "checkpoints", "pretrain", "pretrain/checkpoints", "fits")


@contextmanager
def cleared_after_mistakes(folder: Path, existed: bool | None = None) -> Iterator[None]:
    """Context that removes a newly made folder, and newly made folders above it, if a mistake ends the run.

    A folder with results, trained weights or a checkpoint is never removed, nor one that another process uses.

    Args:
        folder: of the run or the sweep.
        existed: whether it held something before; by default, whether it exists now.
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
    """Context that makes and locks a run's folder.

    Partial files of killed writes are removed. A refused run restores the command line of the run before it; a run
    that fails after it has saved something keeps its own, so that it can be resumed.

    Raises:
        UserError: another run uses the folder.
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
    """Hold the system's lock on a file that names this process; the system releases it when the process dies.

    So the file of a killed run blocks nobody, even if its process number is in use again. Without locks in the
    operating or file system, nothing is locked.

    Raises:
        UserError: another run holds the lock.
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
        except OSError:  # the file system has no locks
            pass
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # the process that held it has just removed the file
    try:
        for part in _OWN:
            remove_leftovers(folder / part)  # first, since they may fill the disk
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


def unused(folder: Path) -> Path:
    """``folder``, or the same name with a number if it holds a run already.

    The name holds time and process, so two runs of a process within a second would share it.
    """
    names = itertools.chain([folder.name], (f"{folder.name}_{number}" for number in itertools.count(2)))
    return next(folder.with_name(name) for name in names if not (folder.with_name(name) / CONFIG).exists())


def earned(folder: Path) -> set[tuple[Path, int]]:
    """The run's files that took time to make, with the times of their last change."""
    found = [path for part in _OWN for name in EARNED for path in (folder / part).glob(name)]
    return {(path, path.stat().st_mtime_ns) for path in found}


def _put_back(folder: Path, kept: dict[str, bytes]) -> None:
    """Restore the files that describe a run; remove those that did not exist before."""
    for name in (OVERRIDES, CONFIG):
        if name in kept:
            write_bytes(folder / name, kept[name])
        else:
            (folder / name).unlink(missing_ok=True)


def _remove_empty(folders: list[Path]) -> None:
    """Remove the empty ones of ``folders``, innermost first."""
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def write_config(composed: Any, overrides: list[str], folder: Path) -> None:
    """Write all values to ``config.yaml`` and the command line to ``overrides.yaml``."""
    write_bytes(folder / CONFIG, OmegaConf.to_yaml(composed, resolve=True).encode())
    write_bytes(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(overrides)).encode())


def stored_command(folder: Path, program: str, without: Sequence[str] = ()) -> str:
    """The command line of the run in ``folder``, ``program`` first, without overrides that start as ``without`` says.

    For a run that was started from Python, it says so in place of a command.
    """
    path = folder / OVERRIDES
    if not path.is_file():
        return f"called from Python: ganlane.api.run({program.rpartition('.')[2].rpartition(' ')[2]!r}, ...)"
    overrides = [str(override) for override in OmegaConf.load(path)]
    return f"{program} {shlex.join(each for each in overrides if not each.startswith(tuple(without)))}".rstrip()
