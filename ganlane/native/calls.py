"""Calls of the kernel: tensors as pointers, rows shared between threads."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch
from torch import Tensor

#: Rows per thread from which on a second thread pays.
ROWS_PER_THREAD = 64
#: The largest number of environments in a vector; threads take a multiple of it.
BLOCK = 16


def addresses(tensors: Sequence[Tensor], count: int) -> ctypes.Array[ctypes.c_void_p]:
    """A struct of ``count`` pointers; those beyond the tensors are null."""
    return (ctypes.c_void_p * count)(*(tensor.data_ptr() for tensor in tensors))


def in_threads(rows: int, call: Callable[[int, int], int]) -> None:
    """``call(first, last)`` for all ``rows``, in as many threads as torch may use.

    Raises:
        MemoryError: a call returned other than 0.
    """
    threads = min(torch.get_num_threads(), rows // ROWS_PER_THREAD)
    if threads <= 1:
        codes = [call(0, rows)]
    else:
        share = -(-rows // (threads * BLOCK)) * BLOCK
        starts = range(0, rows, share)
        codes = list(_pool(threads).map(call, starts, (min(start + share, rows) for start in starts)))
    if any(codes):
        raise MemoryError("the kernel's scratch memory")


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="ganlane-native")


if hasattr(os, "register_at_fork"):
    # A forked child has the pool's object but none of its threads.
    os.register_at_fork(after_in_child=_pool.cache_clear)
