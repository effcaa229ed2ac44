"""``torch.compile`` for the hot functions: several small graphs, which here beat one graph of everything."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from typing import TypeVar

import torch

from ganlane.errors import UserError

F = TypeVar("F", bound=Callable)
#: Graphs that one function may have: one per batch size, road and set of parameters in a process.
GRAPHS_PER_FUNCTION = 64
#: With torch 2.11 on Python 3.12 a NamedTuple that leaves a compiled graph is empty; 2.13 is right.
TRIED_FROM = (2, 13)
COMPILERS = ("c++", "g++", "clang++", "cl")


def has_compiler() -> bool:
    """Whether torch would find a C++ compiler: the one that ``CXX`` names, or one of :data:`COMPILERS`."""
    named = os.environ.get("CXX")
    return any(shutil.which(name) for name in ((named,) if named else COMPILERS))


def can_compile() -> bool:
    """Whether compiling is known to work here: a C++ compiler, and a torch from :data:`TRIED_FROM` on."""
    version = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    return has_compiler() and version >= TRIED_FROM


def check_compiler() -> None:
    """Raise :class:`UserError` where torch would find no C++ compiler."""
    if not has_compiler():
        named = os.environ.get("CXX")
        looked = f"CXX={named}" if named else ", ".join(COMPILERS)
        raise UserError(
            f"compile=true needs a C++ compiler, and there is none (looked for {looked}); install one "
            "(Debian: apt install g++) or set compile=false."
        )


def compiled(function: F) -> F:
    """``function``, a pure function on tensors without branches on their values, as one graph per shape."""
    torch._dynamo.config.cache_size_limit = max(torch._dynamo.config.cache_size_limit, GRAPHS_PER_FUNCTION)
    return torch.compile(function, dynamic=False, fullgraph=True)  # type: ignore[return-value]
