"""Finds, builds and loads the library of the C++ sources, and calls it in threads; without torch
on Linux.

The library is the one that came with the wheel, else one built at first use. That one goes into the
user's cache folder, under a name that follows from the source, the flags and the compiler, so that
another version of any of them builds anew. Processes that build at once do so each for itself; the
last one to finish puts its library in the place of the others', which is the same.

Nothing is taken for granted: a library is loaded only if its checksum holds, a compiler that fails
for the best instruction set is asked for the next one, after it that of the package ``ziglang`` is,
and a cache that cannot be used is passed over.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from ganlane import runtime
from ganlane.errors import UserError
from ganlane.files import CACHE_VARIABLE, PLACE, cache_folder, has_checksum, sealed, write_bytes
from ganlane.runtime import kernel_threads, usable_threads

#: The sources to compile, and what they include.
SOURCES = tuple(sorted(Path(__file__).parent.glob("*.[ch]pp")))
#: Libraries that came with the wheel.
PREBUILT = Path(__file__).with_name("prebuilt")
#: -ffp-contract=off: a product and a sum stay two roundings, so that every instruction set gives
#: the same bits.
FLAGS = (
    "-O3",
    "-std=c++17",
    "-ffp-contract=off",
    "-fno-exceptions",
    "-fPIC",
    "-pthread",
    "-shared",
    "-s",
)
#: The kernel needs no C++ library; zig would compile one first, which takes minutes. Without
#: ``-mcpu`` it would compile for the processor that it runs on.
ZIG_FLAGS = ("-nostdinc++", "-nostdlib++", "-mcpu=baseline")
ADVICE = (
    "install g++ or clang++ (Debian: apt install g++), "
    "or pip install 'ganlane[native]', which brings Clang"
)
#: Functions of the library, and how many pointers they take before the first and the last row.
FUNCTIONS = {
    "decide": 3,
    "lane_view": 3,
    "mask": 3,
    "spawn": 3,
    "enter": 3,
    "step": 1,
    "judge": 1,
    "start": 1,
}
_MOST_POINTERS = max(FUNCTIONS.values())
#: What Linux knows of the processor.
CPU_INFO = Path("/proc/cpuinfo")


class Variant(NamedTuple):
    """An instruction set: environments per vector, compilers' names of its parts, and Linux's."""

    lanes: int
    flags: tuple[str, ...]
    needed: frozenset[str]


# Part by part: GCC knows -march=x86-64-v4 and -v3, which stand for the same, from version 11 on.
_V3_FLAGS = ("-mavx2", "-mbmi", "-mbmi2", "-mf16c", "-mfma", "-mlzcnt", "-mmovbe")
_V4_FLAGS = ("-mavx512f", "-mavx512bw", "-mavx512cd", "-mavx512dq", "-mavx512vl")
_V4 = frozenset({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"})
_V3 = frozenset({"avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"})
#: By the names that torch gives them, the fastest first; ``default`` runs everywhere.
VARIANTS = {
    "AVX512": Variant(16, (*_V3_FLAGS, *_V4_FLAGS), _V4),
    "AVX2": Variant(8, _V3_FLAGS, _V3),
    "default": Variant(4, (), frozenset()),
}


class Loaded(NamedTuple):
    """A library in use, its name in :data:`VARIANTS`, and what made it.

    ``troubles``: what was tried before, and why it failed, as sentences without a full stop.
    """

    library: ctypes.CDLL
    variant: str
    maker: str
    troubles: tuple[str, ...]


def best_variant() -> str:
    """The fastest of :data:`VARIANTS` that this processor runs."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return "default"
    try:
        # Asked of Linux, so that torch need not be imported.
        lines = CPU_INFO.read_text().splitlines()
        flags = next(line for line in lines if line.startswith("flags"))
        parts = set(flags.split())
    except (OSError, StopIteration):  # not Linux
        import torch  # seconds to import

        capability = torch.backends.cpu.get_cpu_capability()
        return capability if capability in VARIANTS else "default"
    return next(name for name, variant in VARIANTS.items() if variant.needed <= parts)


def compilers() -> tuple[tuple[str, ...], ...]:
    """Commands of the C++ compilers to try: that of the system, that of ``ziglang``."""
    commands: list[tuple[str, ...]] = []
    path = runtime.find_compiler()
    if path is not None:
        commands.append((path,))
    if importlib.util.find_spec("ziglang"):
        commands.append((sys.executable, "-m", "ziglang", "c++"))
    return tuple(commands)


def libraries_folder() -> Path | None:
    """Where built libraries are stored: ``native`` in the cache; None: that is off."""
    cache = cache_folder()
    return None if cache is None else cache / "native"


def find(variant: str | None = None) -> Loaded | str:
    """The library for this processor, or for ``variant``; or why there is none, as the end of a
    sentence.

    That of the wheel, else one built by the first compiler that works, for the best instruction set
    for which it does. Once per process; a library that is not the best of this processor, or is
    lost when the process ends, is told of.
    """
    return _find(variant, compilers(), libraries_folder())


def why_not() -> str | None:
    """Why the kernel cannot be built or run here, as the end of a sentence; None if it can."""
    loaded = find()
    return loaded if isinstance(loaded, str) else None


def load(variant: str | None = None) -> ctypes.CDLL:
    """The library that :func:`find` finds.

    Raises:
        UserError: there is none.
    """
    loaded = find(variant)
    if isinstance(loaded, str):
        raise UserError(f"env.kernel=native {loaded}; or set env.kernel=torch.")
    return loaded.library


def load_for(rows: int) -> ctypes.CDLL:
    """The library that is fastest for ``rows`` rule-driven highways; the numbers are the same.

    Raises:
        UserError: there is none.
    """
    # A decision of one row of idm_mobil took 12 us in vectors of 16 and 7 us in vectors of 8, of 8
    # rows 15 and 11 us, of 16 rows 17 and 16 us.
    if rows <= VARIANTS["AVX2"].lanes and best_variant() == "AVX512":
        narrow = find("AVX2")
        if isinstance(narrow, Loaded):
            return narrow.library
    return load()


@lru_cache(maxsize=8)
def _find(
    variant: str | None, commands: tuple[tuple[str, ...], ...], folder: Path | None
) -> Loaded | str:
    """As :func:`find`; what the answer depends on are arguments, since it is stored."""
    if sys.platform == "win32":
        return "is not built for Windows"

    if variant is not None:
        variants = [variant]
    else:
        # The best one of this processor, and after it those that do with less.
        names = list(VARIANTS)
        variants = names[names.index(best_variant()) :]

    for name in variants:
        # That of the wheel fits only if it was built from these very sources.
        content = _whole(_prebuilt(name))
        if content is not None:
            with suppress(OSError):
                library = _opened(_prebuilt(name), content)
                return Loaded(library, name, "the wheel", ())

    # Of each compiler the last failure: the simplest instruction set's says most.
    troubles: dict[str, str] = {}
    for command in commands:
        maker = " ".join(command)
        for name in variants:
            try:
                library = _built(name, command, folder, troubles)
            except (AttributeError, UserError) as error:
                troubles[maker] = f"{maker} failed for {name} ({error})"
                continue
            except OSError as error:  # no matter of the instruction set: on to the next compiler
                troubles[maker] = (
                    f"{maker} or what it made does not run ({error}; where a folder forbids it, "
                    f"point {CACHE_VARIABLE} at another)"
                )
                break

            loaded = Loaded(library, name, maker, tuple(troubles.values()))
            if troubles:
                reasons = "; ".join(loaded.troubles)
                print(
                    f"env.kernel: the kernel for {name} by {maker} drives; {reasons}.",
                    file=sys.stderr,
                )
            return loaded

    reasons = "; ".join(troubles.values()) or "there is no C++ compiler"
    return f"cannot be built: {reasons}; {ADVICE}"


def build_all(folder: Path) -> tuple[list[Path], list[str]]:
    """Build the variants that this kind of machine may run, for a wheel.

    Returns:
        The files, none if no compiler works, and the failures.
    """
    troubles = []
    variants = VARIANTS if platform.machine() in ("x86_64", "AMD64") else ("default",)
    for command in compilers():
        paths = []
        for variant in variants:
            path = folder / _prebuilt(variant).name
            try:
                _opened(path, _compiled(_command(variant, command)))
                paths.append(path)
            except (AttributeError, OSError, UserError) as error:
                troubles.append(f"{' '.join(command)} failed for {variant} ({error})")
        if paths:
            return paths, troubles
    return [], troubles or [f"there is no C++ compiler; {ADVICE}"]


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
    """What all compilers are told, and the environments per vector."""
    return (*FLAGS, f"-DLANES={VARIANTS[variant].lanes}")


def _command(variant: str, compiler: tuple[str, ...]) -> tuple[str, ...]:
    """The compiler's command line but the name of its output."""
    files = (str(source) for source in SOURCES if source.suffix == ".cpp")
    return (
        *compiler,
        *_flags(variant),
        *(ZIG_FLAGS if "ziglang" in compiler else ()),
        *VARIANTS[variant].flags,
        *files,
    )


def _run(command: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    # In English, so that neither the version nor a message depends on the language.
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        errors="replace",
        env={**os.environ, "LC_ALL": "C"},
        check=False,
    )


def _built(
    variant: str, compiler: tuple[str, ...], folder: Path | None, troubles: dict[str, str]
) -> ctypes.CDLL:
    """The library in ``folder``, compiled if it is not whole there.

    Where the folder cannot be used, which joins the ``troubles``, it is loaded from a temporary
    one.

    Raises:
        UserError: the compiler fails.
        OSError: it cannot be run, or its library not be loaded from anywhere.
        AttributeError: its library lacks a function.
    """
    # Another compiler, or another version of it, makes another library.
    command = _command(variant, compiler)
    version = _run((*compiler, "--version")).stdout
    name = _name(variant, *command, version)

    content = _whole(folder / name) if folder else None
    if content is None:
        content = _compiled(command)

    trouble = ""
    if folder:
        try:
            return _opened(folder / name, content)
        except (OSError, UserError) as error:
            why = getattr(error, "strerror", None) or error
            trouble = f"{folder} cannot be used ({why}); point {CACHE_VARIABLE} at another"

    # Once loaded, the file may go.
    with tempfile.TemporaryDirectory(prefix="ganlane-") as temporary:
        library = _opened(Path(temporary) / name, content)
    if trouble:
        # The folder's, then, since the same library could be loaded from another.
        troubles["cache"] = trouble
    return library


def _whole(path: Path) -> bytes | None:
    """The content of a library; None if there is none, or it is damaged."""
    try:
        content = path.read_bytes()
        whole = has_checksum(content, path)
    except (OSError, UserError):
        return None
    return content if whole else None


def _opened(path: Path, content: bytes) -> ctypes.CDLL:
    """The library ``content``, loaded from ``path``, to which it is written if need be.

    Raises:
        UserError, OSError: it cannot be written there, or not be loaded.
        AttributeError: it lacks a function.
    """
    if _whole(path) != content:
        write_bytes(path, content)
    library = ctypes.CDLL(str(path))

    # What each function takes: pointers, then the first row and the one after the last.
    shares = library.ganlane_in_threads
    number = [ctypes.c_long] * 2
    shares.argtypes = [ctypes.c_void_p, ctypes.c_int, *[ctypes.c_void_p] * _MOST_POINTERS, *number]
    shares.restype = ctypes.c_int
    for name, pointers in FUNCTIONS.items():
        function = getattr(library, f"ganlane_{name}")
        function.argtypes = [*[ctypes.c_void_p] * pointers, ctypes.c_long, ctypes.c_long]
        function.restype = ctypes.c_int
        address = ctypes.cast(function, ctypes.c_void_p)
        function.in_threads = partial(shares, address, pointers)  # type: ignore[attr-defined]
    return library


def _compiled(command: tuple[str, ...]) -> bytes:
    """What the compiler makes, with a checksum behind it, which the loader does not look at.

    Raises:
        UserError: it fails; the message is its own.
        OSError: it cannot be run.
    """
    with tempfile.TemporaryDirectory(prefix="ganlane-") as folder:
        path = Path(folder) / "kernel.so"
        done = _run((*command, "-o", str(path)))
        if done.returncode == 0 and path.is_file():
            return sealed(path.read_bytes() + PLACE.encode())

    # The first line with an error, which the further ones may follow from.
    lines = done.stderr.strip().splitlines() or ["no message"]
    message = next((line for line in lines if "error" in line), lines[-1])
    raise UserError(message[:200])


# Calls: arrays as pointers, rows shared between threads

#: Rows per thread from which on a second thread pays, also where it has gone to sleep since the
#: last call. Two threads took, of one's time with idm_mobil through gymnasium on two cores, 0.7 at
#: 128 rows, 0.65 at 256 and 0.55 at 1024; where every step was followed by a pause, 1.4, 1.0, 0.7.
ROWS_PER_THREAD = 128
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
    token = kernel_threads.set(before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        kernel_threads.reset(token)


def threads_allowed() -> int:
    """Those that a command has set, else as many as torch may use.

    Where torch is not loaded, :func:`ganlane.runtime.usable_threads`.
    """
    threads = kernel_threads.get()
    if threads is not None:
        return threads

    torch = sys.modules.get("torch")
    if torch is None:
        return usable_threads()
    return int(torch.get_num_threads())


def in_threads(
    rows: int,
    function: Any,
    pointers: Sequence[Any],
    rows_per_thread: int = ROWS_PER_THREAD,
) -> None:
    """Call a function of the library on all ``rows``, in as many threads as pay and are allowed.

    Rows are independent, so any split between threads gives the same numbers.

    Args:
        rows: how many there are.
        function: of a library that :func:`load` gave.
        pointers: what it takes before the first and the last row.
        rows_per_thread: from which on a further thread pays.

    Raises:
        ValueError: a call returned 2: there is no such action.
        MemoryError: a call returned 1.
    """
    threads = rows // rows_per_thread
    # Not asked for few rows: that takes as long as their decision.
    if threads > 1:
        threads = min(threads_allowed(), threads)

    # ctypes releases Python's lock during a call.
    if threads <= 1:
        code = function(*pointers, 0, rows)
    else:
        # Rounded up to whole vectors, so that no two threads share one.
        share = -(-rows // (threads * BLOCK)) * BLOCK
        padding = [None] * (_MOST_POINTERS - len(pointers))
        code = function.in_threads(*pointers, *padding, rows, share)

    if code == 2:
        raise ValueError("an action is none of those that there are, or no finite number")
    if code:
        raise MemoryError("the kernel's scratch memory")
