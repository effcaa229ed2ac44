"""How the process runs: compiled functions, kept memory, threads; gymnasium's registry.

Torch is imported inside the functions: the command line reads this module before it needs torch.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from pathlib import Path
from typing import Any, Final, TypeVar

from ganlane.errors import UserError

F = TypeVar("F", bound=Callable)
#: Graphs that one function may have: one per batch size, road and set of parameters in a process.
GRAPHS_PER_FUNCTION = 64
#: With torch 2.11 on Python 3.12 a NamedTuple that leaves a compiled graph is empty; 2.13 is right.
TRIED_FROM = (2, 13)
COMPILERS = ("c++", "g++", "clang++", "cl")
#: From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
#: Bytes; blocks up to this size come from the heap, and as much free memory is kept at its end.
KEPT_BYTES = 2**28
_STATUS = Path("/proc/self/status")
ENV_ID: Final = "ganlane/Highway-v0"
#: Id to the arguments that differ; reference scores are in docs/gymnasium.md. The registered specs have no
#: ``max_episode_steps``: gymnasium would cut all episodes there, whatever ``timeout_s`` and ``decision_period_s``
#: are. That of an environment that has been made has the limit that is true for it.
ENV_IDS: Final[dict[str, dict[str, str]]] = {
    ENV_ID: {},
    "ganlane/HighwayDense-v0": {"env": "dense"},
    "ganlane/HighwayGAN-v0": {"traffic": "gan"},
    "ganlane/HighwayGANCalibrated-v0": {"traffic": "gan_calibrated"},
}


def register_envs() -> None:
    """Register the environments with gymnasium, once; without gymnasium nothing happens."""
    try:
        import gymnasium
    except ModuleNotFoundError:  # the rest of the package works; 'ganlane doctor' says what is missing
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
    """Path of the C++ compiler that torch would find, and the names looked for: ``CXX``'s, or :data:`COMPILERS`."""
    named = os.environ.get("CXX")
    names = (named,) if named else COMPILERS
    return next(filter(None, map(shutil.which, names)), None), f"CXX={named}" if named else ", ".join(names)


def has_compiler() -> bool:
    """Whether torch would find a C++ compiler."""
    return find_compiler()[0] is not None


def can_compile() -> bool:
    """Whether compiling is known to work here: a C++ compiler, and a torch from :data:`TRIED_FROM` on."""
    import torch

    version = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    return has_compiler() and version >= TRIED_FROM


def check_compiler() -> None:
    """Raise :class:`UserError` where torch would find no C++ compiler."""
    path, looked = find_compiler()
    if path is None:
        raise UserError(
            f"compile=true needs a C++ compiler, and there is none (looked for {looked}); install one "
            "(Debian: apt install g++) or set compile=false."
        )


def compiled(function: F) -> F:
    """``function``, a pure function on tensors without branches on their values, as one graph per shape."""
    import torch

    torch._dynamo.config.cache_size_limit = max(torch._dynamo.config.cache_size_limit, GRAPHS_PER_FUNCTION)
    return torch.compile(function, dynamic=False, fullgraph=True)  # type: ignore[return-value]


def outside_autocast(function: F) -> F:
    """``function``, computed in the types of its arguments where the caller has switched autocast on."""

    @wraps(function)
    def computed(*arguments: Any, **named: Any) -> Any:
        import torch

        kinds = [kind for kind in ("cpu", "cuda") if torch.is_autocast_enabled(kind)]
        if not kinds:
            return function(*arguments, **named)
        with ExitStack() as stack:
            for kind in kinds:
                stack.enter_context(torch.autocast(kind, enabled=False))
            return function(*arguments, **named)

    return computed  # type: ignore[return-value]


def check_default_device(device: str) -> None:
    """Raise :class:`UserError` where torch makes new tensors neither on the CPU nor on a ``device`` of this type."""
    import torch

    usual = torch.get_default_device().type
    if usual not in ("cpu", device):
        raise UserError(
            f"torch's default device is {usual}, and the highway's tensors would not meet those that are made there; "
            "call torch.set_default_device('cpu') and choose the highway's own with device=."
        )


def check_process() -> None:
    """Raise :class:`UserError` where torch cannot be imported or files cannot be named."""
    if sys.flags.optimize > 1:
        raise UserError("python -OO removes the docstrings, which TorchRL needs; run it without -OO.")
    try:
        os.getcwd()
    except OSError as error:
        raise UserError("the working directory is gone; change to one that is there (cd).") from error


def open_closed_streams() -> None:
    """Send nowhere what is written to streams that the shell has closed (``>&-``), which Python has as None."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            # The lowest free number, so that no file that is opened later gets the number that others write to.
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(nowhere, nowhere == number)
            setattr(sys, name, os.fdopen(nowhere, "w" if number else "r", closefd=False))


def set_threads(threads: int) -> None:
    """Let torch use so many threads; 0 takes one, which is fastest for batches of the sizes used here."""
    import torch

    torch.set_num_threads(threads or 1)


def keep_freed_memory() -> bool:
    """Let the process keep the memory it frees; whether that could be done (on Linux with glibc alone).

    By default glibc hands every large block back to the system as soon as it is free, and taking it again costs a
    page fault per 4 kB: with thousands of environments more than the arithmetic. The peak does not change. It is a
    choice for a whole process, so the commands make it and the library does not.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, KEPT_BYTES)) and bool(mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES))


def peak_resident_bytes() -> int | None:
    """The most memory that this process has held so far; None where the system does not report it.

    Linux's ``ru_maxrss`` is not used: a fresh process inherits its parent's.
    """
    if _STATUS.is_file():
        peaks = [line.split() for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM")]
        return int(peaks[0][1]) * 1024 if peaks else None
    if sys.platform == "darwin":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return None
