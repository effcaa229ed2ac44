"""Peak memory of a case, measured in a process that does nothing else."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch
from tensordict import TensorDictBase

from ganlane.benchmarks.case import Case
from ganlane.benchmarks.timing import torch_threads

_STATUS = Path("/proc/self/status")
#: Decisions after which every buffer that a case needs has been needed.
_DECISIONS = 3
MEGABYTE = 1e6


def peak_resident_bytes() -> int | None:
    """The most memory that this process has held so far; None where the system does not tell.

    Linux's ``ru_maxrss`` is not used: a fresh process inherits its parent's.
    """
    if _STATUS.is_file():
        peaks = [line.split() for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM")]
        return int(peaks[0][1]) * 1024 if peaks else None
    if sys.platform == "darwin":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return None


def peak_of(case: Case) -> int | None:
    """Bytes: of this process on a CPU, of torch's allocations on a GPU; only right in a fresh process."""
    with torch_threads(case.labels.threads):
        run = case.start()
        run(_DECISIONS)
    if case.labels.device == "cuda":
        return torch.cuda.max_memory_allocated()
    return peak_resident_bytes()


def in_fresh_process(function: Callable[[Case], int | None], case: Case) -> int | None:
    """``function(case)`` in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, case).result()


def peak_memory_mb(case: Case) -> float | None:
    """Peak memory of a fresh process that runs the case, Python and torch included; MB."""
    peak = in_fresh_process(peak_of, case)
    return None if peak is None else peak / MEGABYTE


def growth_per_environment(small: Case, large: Case) -> float | None:
    """Bytes by which peak memory grows with every environment, from two batch sizes in fresh processes."""
    low, high = (in_fresh_process(peak_of, case) for case in (small, large))
    if low is None or high is None:
        return None
    return (high - low) / (large.labels.batch - small.labels.batch)


def bytes_of(tensordict: TensorDictBase) -> int:
    """Bytes of all tensors in it."""
    leaves = tensordict.values(include_nested=True, leaves_only=True)
    return sum(leaf.numel() * leaf.element_size() for leaf in leaves)
