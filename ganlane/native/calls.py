"""Calls of the kernel: arrays as pointers, rows shared between threads. Imports no torch."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import Any

#: Rows per thread from which on a second thread pays: idm_mobil through gymnasium on two cores took 1.3 times as long
#: with two threads at 128 rows, 1.0 times at 256, 0.8 times at 512, 0.65 times at 1024 and 0.55 times at 4096.
ROWS_PER_THREAD = 192
#: The largest number of environments in a vector; threads take a multiple of it.
BLOCK = 16


def addresses(arrays: Sequence[Any], count: int) -> ctypes.Array[ctypes.c_void_p]:
    """A struct of ``count`` pointers to tensors or NumPy arrays; those beyond the arrays are null."""
    return (ctypes.c_void_p * count)(
        *(each.ctypes.data if hasattr(each, "ctypes") else each.data_ptr() for each in arrays)
    )


#: Threads of the kernel while torch has but one (:func:`torch_on_one_thread`); None: as many as torch.
_threads: ContextVar[int | None] = ContextVar("threads of the kernel", default=None)


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Inside, torch computes on one thread, and the kernel on as many as torch had.

    Around the kernel torch works on small tensors, which it is slow to share out: a step of 4096 environments through
    TorchRL took 6.8 ms on one core, 7.3 ms with two threads for torch and the kernel, and 5.2 ms with two for the
    kernel alone. A thread that calls torch for the first time while another one is inside keeps one thread.
    """
    torch = sys.modules["torch"]
    before = int(torch.get_num_threads())
    if before == 1:
        yield
        return
    token = _threads.set(before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _threads.reset(token)


def threads_allowed() -> int:
    """As many threads as torch may use; where torch is not loaded, ``OMP_NUM_THREADS`` or the processor's cores."""
    own, torch = _threads.get(), sys.modules.get("torch")
    if own is not None:
        return own
    if torch is not None:
        return int(torch.get_num_threads())
    named = os.environ.get("OMP_NUM_THREADS", "")
    return int(named) if named.isdigit() and int(named) > 0 else os.cpu_count() or 1


def in_threads(rows: int, call: Callable[[int, int], int]) -> None:
    """``call(first, last)`` for all ``rows``, in as many threads as pay and are allowed.

    Raises:
        ValueError: a call returned 2: an action is not 0, 1 or 2.
        MemoryError: a call returned 1.
    """
    threads = 1 if rows < 2 * ROWS_PER_THREAD else min(threads_allowed(), rows // ROWS_PER_THREAD)
    if threads <= 1:
        codes = [call(0, rows)]
    else:
        share = -(-rows // (threads * BLOCK)) * BLOCK
        starts = range(0, rows, share)
        others = [_pool(threads - 1).submit(call, start, min(start + share, rows)) for start in starts[1:]]
        codes = [call(0, share), *(other.result() for other in others)]  # this thread does not wait idle
    if 2 in codes:
        raise ValueError("an action is not 0, 1 or 2")
    if any(codes):
        raise MemoryError("the kernel's scratch memory")


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="ganlane-native")


if hasattr(os, "register_at_fork"):
    # A forked child has the pool's object but none of its threads.
    os.register_at_fork(after_in_child=_pool.cache_clear)
