"""Settings of the process: compiler, memory, streams; registration with gymnasium.

Without torch, which the command line does not need at first; its settings are in
:mod:`ganlane.torch_settings`.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Final

from ganlane.errors import USER_ERROR, UserError, file_sentence, is_users_matter

#: Exit status when the reader of the output has closed it: 128 plus the number of SIGPIPE, which
#: Windows lacks.
READER_LEFT = 141
COMPILERS = ("c++", "g++", "clang++", "cl")
#: From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
#: Bytes; blocks up to this size come from the heap, and as much free memory is kept at its end.
KEPT_BYTES = 2**28
#: Threads of the native kernel, where they are not as many as torch's.
kernel_threads: ContextVar[int | None] = ContextVar("threads of the kernel", default=None)
ENV_ID: Final = "ganlane/Highway-v0"
#: Arguments that differ from the defaults, by id; reference scores are in docs/gymnasium.md. The
#: registered specs have no ``max_episode_steps``: gymnasium would cut all episodes there, whatever
#: ``timeout_s`` and ``decision_period_s`` are. The spec of a made environment has its actual limit.
ENV_IDS: Final[dict[str, dict[str, str]]] = {
    ENV_ID: {},
    "ganlane/HighwayDense-v0": {"env": "dense"},
    "ganlane/HighwayGAN-v0": {"traffic": "gan"},
    "ganlane/HighwayGANCalibrated-v0": {"traffic": "gan_calibrated"},
}


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def usable_threads() -> int:
    """``OMP_NUM_THREADS``, else a thread for every usable core."""
    named = os.environ.get("OMP_NUM_THREADS", "")
    # OpenMP allows a list of them, one for each level; that is taken for none.
    if named.isdigit() and int(named) > 0:
        return int(named)
    return usable_cores()


def register_envs() -> None:
    """Register the environments with gymnasium, once; do nothing without gymnasium."""
    try:
        import gymnasium
    # The rest of the package works; 'ganlane doctor' says what is missing.
    except ModuleNotFoundError:
        return

    for name, arguments in ENV_IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="ganlane.gym.single:HighwayGym",
                vector_entry_point="ganlane.gym.vector:HighwayVectorGym",
                kwargs=arguments,
            )


def find_compiler() -> str | None:
    """Path of the C++ compiler that torch would find: ``CXX``'s, or one of :data:`COMPILERS`."""
    named = os.environ.get("CXX")
    names = (named,) if named else COMPILERS
    return next(filter(None, map(shutil.which, names)), None)


def has_compiler() -> bool:
    """Whether torch would find a C++ compiler, and it works."""
    path = find_compiler()
    return path is not None and _compiles(path)


@lru_cache(maxsize=4)
def _compiles(compiler: str) -> bool:
    """Whether a file that needs a header of the system compiles."""
    with tempfile.TemporaryDirectory(prefix="ganlane-") as folder:
        (Path(folder) / "trial.cpp").write_text("#include <cmath>\n")
        try:
            command = [compiler, "-c", "trial.cpp"]
            subprocess.run(command, cwd=folder, capture_output=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return False
        return len(os.listdir(folder)) > 1


def check_process() -> None:
    """Raise :class:`UserError` if TorchRL cannot be imported (``-OO``) or the working directory is
    gone.
    """
    if sys.flags.optimize > 1:
        raise UserError(
            "python -OO removes the docstrings, which TorchRL needs; run it without -OO."
        )
    try:
        os.getcwd()
    except OSError as error:
        raise UserError(
            "the working directory is gone; change to one that is there (cd)."
        ) from error


def open_closed_streams() -> None:
    """Open streams that the shell has closed (``>&-``), for which Python has None, on
    ``os.devnull``.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            # It gets the lowest free number, so that no file opened later gets a number that
            # libraries write to.
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(nowhere, nowhere == number)
            setattr(sys, name, os.fdopen(nowhere, "w" if number else "r", closefd=False))


def status_of(error: OSError, program: str) -> int:
    """The exit status after an error of the file system, whose sentence is printed.

    Raises:
        OSError: the error, where it is no matter of the user's.
    """
    # Python writes again at exit, and would fail with a message and a status of its own: what a
    # stream that refuses still holds goes nowhere.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)

    if isinstance(error, BrokenPipeError):
        return READER_LEFT
    if not is_users_matter(error):
        raise error
    print(f"{program}: {file_sentence(error)}", file=sys.stderr)
    return USER_ERROR


def keep_freed_memory() -> bool:
    """Let the process keep the memory it frees; return whether that is possible (only on Linux with
    glibc).

    By default glibc returns every large block to the system as soon as it is free, and taking it
    again costs a page fault per 4 kB, with thousands of environments more than the arithmetic. The
    peak does not change. The commands set this and the library does not, because it holds for the
    whole process.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return all(mallopt(size, KEPT_BYTES) for size in (_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD))


def worker_number() -> int:
    """A number from 1 of this process among TorchRL's workers; 0 where it is none of them.

    Counted by the process that started it, so a program that runs again has the same numbers.
    """
    process = multiprocessing.current_process()
    target = getattr(process, "_target", None)
    module = getattr(target, "__module__", None) or ""
    if not module.startswith("torchrl."):
        return 0

    number = 0
    # A worker of a worker has one part for each of both.
    for part in getattr(process, "_identity", ()):
        number = 1000 * number + part
    return number
