"""Torch's settings: compiled functions, autocast, default device, threads; constant tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache, wraps
from typing import Any, TypeVar

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.runtime import has_compiler, kernel_threads, usable_threads

F = TypeVar("F", bound=Callable)
#: Graphs that one function may have: one per batch size, road and set of parameters in a process.
GRAPHS_PER_FUNCTION = 64
#: First torch whose compiler is known to be right: 2.11 on Python 3.12 returns empty NamedTuples
#: from a graph.
TRIED_FROM = (2, 13)


def can_compile() -> bool:
    """Whether compiling is known to work here.

    A C++ compiler, and a torch from :data:`TRIED_FROM` on.
    """
    # "2.13.0+cu128"
    release, _, _ = torch.__version__.partition("+")
    version = tuple(int(part) for part in release.split(".")[:2])
    return has_compiler() and version >= TRIED_FROM


def compiled(function: F) -> F:
    """Compile ``function`` to one graph per shape.

    It is pure, on tensors, and has no branches on their values.
    """
    # Beyond its limit torch falls back to uncompiled code without a word.
    torch._dynamo.config.cache_size_limit = max(
        torch._dynamo.config.cache_size_limit, GRAPHS_PER_FUNCTION
    )
    return torch.compile(function, dynamic=False, fullgraph=True)  # type: ignore[return-value]


def constant(values: Sequence[float], like: Tensor) -> Tensor:
    """``values`` in the type and on the device of ``like``; shared, so never to be written to.

    Made once: a GPU would wait for each copy from the host.
    """
    # A graph has its own constants.
    if torch.compiler.is_compiling():
        return like.new_tensor(values)
    return _constant(tuple(values), like.dtype, like.device)


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    # A tensor made in inference mode could not be used outside of it.
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


def outside_autocast(function: F) -> F:
    """Let ``function`` compute in the types of its arguments, even under a caller's autocast."""

    @wraps(function)
    def computed(*arguments: Any, **named: Any) -> Any:
        kinds = [kind for kind in ("cpu", "cuda") if torch.is_autocast_enabled(kind)]
        if not kinds:
            return function(*arguments, **named)

        with ExitStack() as stack:
            for kind in kinds:
                stack.enter_context(torch.autocast(kind, enabled=False))
            return function(*arguments, **named)

    return computed  # type: ignore[return-value]


def check_default_device(device: str) -> None:
    """Raise :class:`UserError` if torch's default device is not the CPU or of type ``device``."""
    # Constants are made without a device, so they would land there.
    default = torch.get_default_device().type
    if default not in ("cpu", device):
        raise UserError(
            f"torch's default device is {default}, and the highway's tensors would not meet those "
            "that are made there; call torch.set_default_device('cpu') and choose the highway's "
            "own with device=."
        )


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set the threads of torch and of the native kernel; in the end they are as before.

    0 means one for torch, the fastest for the batch sizes used here, and all usable cores for the
    kernel, whose threads wait for each other without computing.
    """
    # In a notebook the number is the caller's, and further cells rely on it.
    before = torch.get_num_threads()
    torch.set_num_threads(threads or 1)
    token = kernel_threads.set(threads or usable_threads())
    try:
        yield
    finally:
        torch.set_num_threads(before)
        kernel_threads.reset(token)
