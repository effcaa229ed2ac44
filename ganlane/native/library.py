"""Loads the library of the C++ sources and calls its functions, in threads; needs torch off Linux
alone.

The library is the one that came with the wheel, else one built at first use. That one goes into the
user's cache folder, under a name that follows from the source, the flags and the compiler, so that
another version of any of them builds anew. Processes that build at once do so each for itself; the
last one to finish puts its library in the place of the others', which is the same.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from ganlane import runtime
from ganlane.errors import UserError
from ganlane.files import CACHE_VARIABLE, cache_folder

#: The sources to compile, and what they include.
SOURCES = tuple(sorted(Path(__file__).parent.glob("*.[ch]pp")))
#: Libraries that came with the wheel.
PREBUILT = Path(__file__).with_name("prebuilt")
#: -ffp-contract=off: a product and a sum stay two roundings, so that every instruction set gives
#: the same bits.
FLAGS = ("-O3", "-std=c++17", "-ffp-contract=off", "-fno-exceptions", "-fPIC", "-shared", "-s")
#: The kernel needs no C++ library; zig would compile one first, which takes minutes.
ZIG_FLAGS = ("-nostdinc++", "-nostdlib++")
ADVICE = (
    "install g++ or clang++ (Debian: apt install g++), "
    "or pip install 'ganlane[native]', which brings Clang."
)
#: Functions of the library, and how many pointers they take before the first and the last row.
FUNCTIONS = {"decide": 3, "lane_view": 3, "mask": 3, "spawn": 3, "enter": 3, "step": 1, "start": 1}
#: What Linux knows of the processor.
CPU_INFO = Path("/proc/cpuinfo")


class Variant(NamedTuple):
    """An instruction set.

    Environments per vector, what GCC and Clang, and zig, call it, and Linux its parts.
    """

    lanes: int
    flags: tuple[str, ...]
    zig_flags: tuple[str, ...]
    needed: frozenset[str]


_V4 = frozenset({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"})
_V3 = frozenset({"avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"})
#: By the names that torch gives them, the fastest first; ``default`` runs everywhere.
VARIANTS = {
    "AVX512": Variant(16, ("-march=x86-64-v4",), ("-mcpu=x86_64_v4",), _V4),
    "AVX2": Variant(8, ("-march=x86-64-v3",), ("-mcpu=x86_64_v3",), _V3),
    "default": Variant(4, (), (), frozenset()),
}


def best_variant() -> str:
    """The fastest of :data:`VARIANTS` that this processor runs."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return "default"
    try:
        # Asked of Linux, so that torch need not be imported.
        lines = CPU_INFO.read_text().splitlines()
        parts = set(next(line for line in lines if line.startswith("flags")).split())
    except (OSError, StopIteration):  # not Linux
        import torch  # seconds to import

        capability = torch.backends.cpu.get_cpu_capability()
        return capability if capability in VARIANTS else "default"
    return next(name for name, variant in VARIANTS.items() if variant.needed <= parts)


def compiler_command() -> tuple[str, ...] | None:
    """The command of a C++ compiler, that of the package ``ziglang`` if need be.

    None if there is none.
    """
    # A compiler of the system first, else that of zig.
    path, _ = runtime.find_compiler()
    if path is not None:
        return (path,)
    if importlib.util.find_spec("ziglang"):
        return (sys.executable, "-m", "ziglang", "c++")
    return None


def libraries_folder() -> Path:
    """Where built libraries are kept: ``native`` in the cache.

    Where that is off, a folder that goes when the process ends.
    """
    cache = cache_folder()
    return _passing_folder() if cache is None else cache / "native"


@lru_cache(maxsize=1)
def _passing_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="ganlane-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def why_not() -> str | None:
    """Why the kernel cannot be built or run here, as the end of a sentence; None if it can."""
    if sys.platform == "win32":
        return "is not built for Windows"
    if compiler_command() or _prebuilt(best_variant()).is_file():
        return None
    return f"needs a C++ compiler, and there is none; {ADVICE}"


def load(variant: str | None = None) -> ctypes.CDLL:
    """The library for this processor, or for ``variant``: that of the wheel, else built if it is
    not there yet.

    Raises:
        UserError: there is no compiler, it fails, or the cache folder cannot be written.
    """
    return _load(variant or best_variant(), compiler_command(), libraries_folder())


@lru_cache(maxsize=8)
def _load(
    variant: str,
    compiler: tuple[str, ...] | None,
    folder: Path,
) -> ctypes.CDLL:
    # That of the wheel fits only if it was built from these very sources.
    path = _prebuilt(variant)
    if not path.is_file():
        reason = why_not()
        if compiler is None or reason:
            raise UserError(f"env.kernel=native {reason} Or set env.kernel=torch.")
        command = _command(variant, compiler)
        # Another compiler, or another version of it, makes another library.
        version = _run((*compiler, "--version")).stdout
        path = folder / _name(variant, *command, version)
        if not path.is_file():
            _build(command, path)
    library = ctypes.CDLL(str(path))
    for name, pointers in FUNCTIONS.items():
        function = getattr(library, f"ganlane_{name}")
        function.argtypes = [*[ctypes.c_void_p] * pointers, ctypes.c_long, ctypes.c_long]
        function.restype = ctypes.c_int
    return library


def build_all(folder: Path) -> list[Path]:
    """Build the variants that this kind of machine may run, for a wheel; the files.

    Raises:
        UserError: there is no compiler, or it fails.
    """
    compiler = compiler_command()
    if compiler is None:
        raise UserError(f"there is no C++ compiler; {ADVICE}")
    paths = []
    for variant in VARIANTS if platform.machine() in ("x86_64", "AMD64") else ("default",):
        path = folder / _prebuilt(variant).name
        _build(_command(variant, compiler), path)
        paths.append(path)
    return paths


def _prebuilt(variant: str) -> Path:
    """Where a wheel has the library of these sources."""
    return PREBUILT / _name(variant, *_flags(variant), platform.machine())


def _name(variant: str, *parts: str) -> str:
    """A file name that follows from the sources and from what else makes a library."""
    # A file of that name is never out of date.
    sources = [source.read_text() for source in SOURCES]
    digest = hashlib.sha256("\0".join((*sources, *parts)).encode()).hexdigest()
    return f"kernel-{variant.lower()}-{digest[:20]}.so"


def _flags(variant: str) -> tuple[str, ...]:
    return (*FLAGS, f"-DLANES={VARIANTS[variant].lanes}")


def _command(variant: str, compiler: tuple[str, ...]) -> tuple[str, ...]:
    machine = VARIANTS[variant].flags
    if "ziglang" in compiler:
        machine = (*ZIG_FLAGS, *VARIANTS[variant].zig_flags)
    files = (str(source) for source in SOURCES if source.suffix == ".cpp")
    return (*compiler, *_flags(variant), *machine, *files)


def _run(command: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
    )


def _build(command: tuple[str, ...], library: Path) -> None:
    """Compile into a file of this process's own, then rename it, which is atomic."""
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            built = Path(folder) / library.name
            done = _run((*command, "-o", str(built)))
            if done.returncode != 0:
                last = (done.stderr.strip().splitlines() or ["no message"])[-1]
                raise UserError(
                    f"env.kernel=native: {command[0]} failed ({last}); "
                    f"set env.kernel=torch or {ADVICE}"
                )
            built.replace(library)
    except OSError as error:
        raise UserError(
            f"env.kernel=native: {library.parent} cannot be written ({error.strerror}); "
            f"point {CACHE_VARIABLE} at a folder that can, or set env.kernel=torch."
        ) from error


# Calls: arrays as pointers, rows shared between threads

#: Rows per thread from which on a second thread pays: idm_mobil through gymnasium on two cores took
#: 1.3 times as long with two threads at 128 rows, 1.0 times at 256, 0.8 times at 512, 0.65 times at
#: 1024 and 0.55 times at 4096.
ROWS_PER_THREAD = 192
#: The largest number of environments in a vector; threads take a multiple of it. A decision of so
#: many rows of generated traffic takes 2 ms, so that is what a thread pays for there.
BLOCK = 16


def addresses(arrays: Sequence[Any]) -> ctypes.Array[ctypes.c_void_p]:
    """A struct of pointers to tensors or NumPy arrays; None: a null pointer."""
    pointers = (ctypes.c_void_p * len(arrays))()
    for index, array in enumerate(arrays):
        if array is not None:
            is_numpy = hasattr(array, "ctypes")
            pointers[index] = array.ctypes.data if is_numpy else array.data_ptr()
    return pointers


#: Threads of the kernel while torch has but one (:func:`torch_on_one_thread`); None: as many as
#: torch.
_threads: ContextVar[int | None] = ContextVar("threads of the kernel", default=None)


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Inside, torch computes on one thread, and the kernel on as many as torch had.

    Around the kernel torch works on small tensors, which it is slow to share out: a step of 4096
    environments through TorchRL took 6.8 ms on one core, 7.3 ms with two threads for torch and the
    kernel, and 5.2 ms with two for the kernel alone. A thread that calls torch for the first time
    while another one is inside keeps one thread.
    """
    torch = sys.modules["torch"]
    before = int(torch.get_num_threads())
    if before == 1:
        yield
        return
    # A context variable: each thread that calls has its own.
    token = _threads.set(before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _threads.reset(token)


def threads_allowed() -> int:
    """As many threads as torch may use.

    Where torch is not loaded, ``OMP_NUM_THREADS`` or the processor's cores.
    """
    set_aside = _threads.get()
    torch = sys.modules.get("torch")
    if set_aside is not None:
        return set_aside
    if torch is not None:
        return int(torch.get_num_threads())
    named = os.environ.get("OMP_NUM_THREADS", "")
    if named.isdigit() and int(named) > 0:
        return int(named)
    return os.cpu_count() or 1


def in_threads(
    rows: int, call: Callable[[int, int], int], rows_per_thread: int = ROWS_PER_THREAD
) -> None:
    """``call(first, last)`` for all ``rows``, in as many threads as pay and are allowed.

    Raises:
        ValueError: a call returned 2: an action is not 0, 1 or 2.
        MemoryError: a call returned 1.
    """
    threads = min(threads_allowed(), rows // rows_per_thread)
    if threads <= 1:
        codes = [call(0, rows)]
    else:
        # Rounded up to whole vectors, so that no two threads share one.
        share = -(-rows // (threads * BLOCK)) * BLOCK
        pool = _pool(threads - 1)
        others = [
            pool.submit(call, start, min(start + share, rows))
            for start in range(share, rows, share)
        ]
        # this thread does not wait idle
        codes = [call(0, share), *(other.result() for other in others)]
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
