"""Which code ran, and on what machine: for the records that numbers are kept in."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from ganlane._version import __version__
from ganlane.files import PACKAGE


def _git(*arguments: str) -> str | None:
    """Output of a git command in the package's folder; None where git is absent or says no."""
    command = ["git", "-C", str(PACKAGE), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def code_version() -> dict[str, Any]:
    """``version`` of the package, and ``revision`` and ``modified`` where it lies in a checkout of its own.

    An installed copy inside somebody else's checkout has no revision: git must know the package's own file.
    """
    version: dict[str, Any] = {"version": __version__, "revision": None, "modified": None}
    if _git("ls-files", "--error-unmatch", "__init__.py") is not None:
        version["revision"] = _git("rev-parse", "HEAD")
        version["modified"] = bool(_git("status", "--porcelain", "--untracked-files=no", "--", "."))
    return version


def _cpu_name(info: Path = Path("/proc/cpuinfo")) -> str:
    """The processor's name, as well as the system tells it."""
    if info.is_file():
        for line in info.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine() -> dict[str, Any]:
    """CPU, usable cores, torch's threads, system, accelerator (or None), and the versions that ran."""
    return {
        "cpu": _cpu_name(),
        "cores": _usable_cores(),
        "threads": torch.get_num_threads(),
        "system": platform.platform(),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
