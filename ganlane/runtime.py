"""Settings of the process: compiler, memory, streams; registration with gymnasium.

Without torch, which the command line does not need at first; its settings are in
:mod:`ganlane.torch_settings`.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import select
import shutil
import subprocess
import sys
import tempfile
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Final, TextIO

from ganlane.errors import USER_ERROR, UserError, file_sentence, is_users_matter

#: Exit status when the reader of the output has closed it: 128 plus the number of SIGPIPE, which
#: Windows lacks.
READER_LEFT = 141
COMPILERS = ("c++", "g++", "clang++", "cl")
#: From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
#: Bytes; blocks up to this size come from the heap, and as much free memory is kept at its end.
KEPT_BYTES = 2**28
_STATUS = Path("/proc/self/status")
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
    return int(named) if named.isdigit() and int(named) > 0 else usable_cores()


def register_envs() -> None:
    """Register the environments with gymnasium, once; do nothing without gymnasium."""
    try:
        import gymnasium
    # the rest of the package works; 'ganlane doctor' says what is missing
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


def find_compiler() -> tuple[str | None, str]:
    """Path of the C++ compiler that torch would find, and the names looked for.

    ``CXX``'s, or :data:`COMPILERS`.
    """
    named = os.environ.get("CXX")
    names = (named,) if named else COMPILERS
    return next(
        filter(None, map(shutil.which, names)), None
    ), f"CXX={named}" if named else ", ".join(names)


def has_compiler() -> bool:
    """Whether torch would find a C++ compiler, and it works."""
    path, _ = find_compiler()
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


def check_compiler() -> None:
    """Raise :class:`UserError` where torch would find no C++ compiler that works."""
    path, names = find_compiler()
    if not has_compiler():
        trouble = f"there is none (looked for {names})" if path is None else f"{path} fails"
        raise UserError(
            f"compile=true needs a C++ compiler, and {trouble}; install one "
            "(Debian: apt install g++) or set compile=false."
        )


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
    if _discard_broken_streams() and isinstance(error, BrokenPipeError):
        return READER_LEFT
    if not is_users_matter(error):
        raise error
    print(f"{program}: {file_sentence(error)}", file=sys.stderr)
    return USER_ERROR


def _discard_broken_streams() -> bool:
    """Redirect streams that cannot be written to os.devnull; return whether the reader of a pipe
    has closed it.

    Otherwise Python would write again at exit, print an error, and exit with a status of its own.
    """
    closed = [_has_no_reader(stream) for stream in (sys.stdout, sys.stderr)]
    for stream, gone in zip((sys.stdout, sys.stderr), closed):
        try:
            stream.flush()
        except OSError:
            gone = True
        if gone:
            devnull = os.open(os.devnull, os.O_WRONLY)
            os.dup2(devnull, stream.fileno())
            os.close(devnull)
    return any(closed)


def _has_no_reader(stream: TextIO) -> bool:
    """Whether the stream is a pipe without a reader; always False on Windows."""
    try:
        poll = select.poll()
        poll.register(stream.fileno(), 0)
    except (AttributeError, OSError):  # Windows, or a stream without a file, as in a notebook
        return False
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


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
    return bool(mallopt(_M_MMAP_THRESHOLD, KEPT_BYTES)) and bool(
        mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)
    )


def worker_number() -> int:
    """A number from 1 of this process among TorchRL's workers; 0 where it is none of them.

    Counted by the process that started it, so a program that runs again has the same numbers.
    """
    process = multiprocessing.current_process()
    module = getattr(getattr(process, "_target", None), "__module__", None) or ""
    if not module.startswith("torchrl."):
        return 0
    number = 0
    # A worker of a worker has one part for each of both.
    for part in getattr(process, "_identity", ()):
        number = 1000 * number + part
    return number


def peak_resident_bytes() -> int | None:
    """Peak resident memory of this process so far; None where the system does not report it.

    Linux's ``ru_maxrss`` is not used: a fresh process inherits its parent's.
    """
    if _STATUS.is_file():
        peaks = [
            line.split() for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM")
        ]
        return int(peaks[0][1]) * 1024 if peaks else None
    if sys.platform == "darwin":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return None
