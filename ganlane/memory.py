"""A process's memory: keeping what is freed, and the peak.

By default glibc hands every large block back to the system as soon as it is free, and taking it again costs a page
fault per 4 kB. With batches of thousands of environments, or with many vehicles, that costs more than the arithmetic,
so what a large batch frees in one step stays with the process for the next.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

#: From glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
#: Bytes; blocks up to this come from the heap, and so much free memory is kept at its end.
KEPT = 2**28
_STATUS = Path("/proc/self/status")


def keep_freed_memory() -> bool:
    """Let the process keep what it frees; whether that could be done (on Linux with glibc, else nothing happens).

    A choice for a whole process, so the commands make it and the library does not. The peak is what it was.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, KEPT)) and bool(mallopt(_M_TRIM_THRESHOLD, KEPT))


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
