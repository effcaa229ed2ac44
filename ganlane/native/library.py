"""Loads the library of the C++ sources: the one that came with the wheel, else one built at first use.

That one goes into the user's cache folder, under a name that follows from the source, the flags and the compiler,
so that another version of any of them builds anew. Processes that build at once do so each for itself; the last one
to finish puts its library in the place of the others', which is the same.
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
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from ganlane.errors import UserError

FILES = (
    "kernel.cpp",
    "observation.cpp",
    "mask.cpp",
    "spawn.cpp",
    "step.cpp",
    "arrays.hpp",
    "model.hpp",
    "vectors.hpp",
)
#: The sources to compile, and what they include.
SOURCES = tuple(Path(__file__).with_name(name) for name in FILES)
#: Libraries that came with the wheel.
PREBUILT = Path(__file__).with_name("prebuilt")
#: -ffp-contract=off: a product and a sum stay two roundings, so that every instruction set gives the same bits.
FLAGS = ("-O3", "-std=c++17", "-ffp-contract=off", "-fno-exceptions", "-fPIC", "-shared", "-s")
#: The kernel needs no C++ library; zig would compile one first, which takes minutes.
ZIG_FLAGS = ("-nostdinc++", "-nostdlib++")
ADVICE = "install g++ or clang++ (Debian: apt install g++), or pip install 'ganlane[native]', which brings Clang."


class Variant(NamedTuple):
    """An instruction set: environments per vector, and what GCC and Clang, and zig, call it."""

    lanes: int
    flags: tuple[str, ...]
    zig_flags: tuple[str, ...]


#: By the names that torch gives them; ``default`` runs everywhere.
VARIANTS = {
    "AVX512": Variant(16, ("-march=x86-64-v4",), ("-mcpu=x86_64_v4",)),
    "AVX2": Variant(8, ("-march=x86-64-v3",), ("-mcpu=x86_64_v3",)),
    "default": Variant(4, (), ()),
}


#: What Linux knows of the processor.
CPU_INFO = Path("/proc/cpuinfo")
#: What a processor must have for a variant (x86-64-v4 and -v3), by the names of Linux.
_NEEDED = {
    "AVX512": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "AVX2": {"avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"},
}


def best_variant() -> str:
    """The fastest of :data:`VARIANTS` that this processor runs."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return "default"
    try:
        lines = CPU_INFO.read_text().splitlines()
        found = set(next(line for line in lines if line.startswith("flags")).split())
    except (OSError, StopIteration):  # not Linux
        import torch  # seconds to import

        capability = torch.backends.cpu.get_cpu_capability()
        return capability if capability in VARIANTS else "default"
    return next((name for name, needed in _NEEDED.items() if needed <= found), "default")


def find_compiler() -> tuple[str, ...] | None:
    """The command of a C++ compiler: ``CXX``, g++, clang++ or the package ``ziglang``; None if there is none."""
    for name in (os.environ.get("CXX"), "g++", "clang++"):
        found = name and shutil.which(name)
        if found:
            return (found,)
    return (sys.executable, "-m", "ziglang", "c++") if importlib.util.find_spec("ziglang") else None


def cache_folder() -> Path:
    """Where built libraries are kept: ``native`` in the folder ``GANLANE_CACHE``, by default the user's.

    If that variable is empty, which switches caches off, a folder that goes when the process ends.
    """
    named = os.environ.get("GANLANE_CACHE")
    if named == "":
        return _passing_folder()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ganlane"
    return (Path(named) if named else cache) / "native"


@lru_cache(maxsize=1)
def _passing_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="ganlane-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def why_not() -> str | None:
    """Why the kernel cannot be built or run here, as the end of a sentence; None if it can."""
    if sys.platform == "win32":
        return "is not built for Windows"
    if find_compiler() or _prebuilt(best_variant()).is_file():
        return None
    return f"needs a C++ compiler, and there is none; {ADVICE}"


def load(variant: str | None = None) -> ctypes.CDLL:
    """The library for this processor, or for ``variant``: that of the wheel, else built if it is not there yet.

    Raises:
        UserError: there is no compiler, it fails, or the cache folder cannot be written.
    """
    return _load(variant or best_variant(), find_compiler(), cache_folder())


@lru_cache(maxsize=8)
def _load(variant: str, compiler: tuple[str, ...] | None, folder: Path) -> ctypes.CDLL:
    prebuilt = _prebuilt(variant)
    if prebuilt.is_file():
        return _declared(ctypes.CDLL(str(prebuilt)))
    reason = why_not()
    if compiler is None or reason:
        raise UserError(f"env.kernel=native {reason} Or set env.kernel=torch.")
    command = _command(variant, compiler)
    name = _digest(*_sources(), *command, _run((*compiler, "--version")).stdout)
    library = folder / f"kernel-{variant.lower()}-{name}.so"
    if not library.is_file():
        _build(command, library)
    return _declared(ctypes.CDLL(str(library)))


def build_all(folder: Path) -> list[Path]:
    """Build the variants that this kind of machine may run, for a wheel; the files.

    Raises:
        UserError: there is no compiler, or it fails.
    """
    compiler = find_compiler()
    if compiler is None:
        raise UserError(f"there is no C++ compiler; {ADVICE}")
    made = []
    for variant in VARIANTS if platform.machine() in ("x86_64", "AMD64") else ("default",):
        made.append(folder / _prebuilt(variant).name)
        _build(_command(variant, compiler), made[-1])
    return made


def _prebuilt(variant: str) -> Path:
    """Where a wheel has the library of these sources."""
    name = _digest(*_sources(), *_flags(variant), platform.machine())
    return PREBUILT / f"kernel-{variant.lower()}-{name}.so"


def _flags(variant: str) -> tuple[str, ...]:
    return (*FLAGS, f"-DLANES={VARIANTS[variant].lanes}")


def _command(variant: str, compiler: tuple[str, ...]) -> tuple[str, ...]:
    _, flags, zig_flags = VARIANTS[variant]
    own = (*ZIG_FLAGS, *zig_flags) if "ziglang" in compiler else flags
    return (*compiler, *_flags(variant), *own, *(str(source) for source in SOURCES if source.suffix == ".cpp"))


def _sources() -> tuple[str, ...]:
    return tuple(source.read_text() for source in SOURCES)


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]


def _run(command: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


def _build(command: tuple[str, ...], library: Path) -> None:
    """Compile into a file of this process's own, then rename it, which is atomic."""
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            made = Path(folder) / library.name
            done = _run((*command, "-o", str(made)))
            if done.returncode != 0:
                last = (done.stderr.strip().splitlines() or ["no message"])[-1]
                raise UserError(f"env.kernel=native: {command[0]} failed ({last}); set env.kernel=torch or {ADVICE}")
            made.replace(library)
    except OSError as error:
        raise UserError(
            f"env.kernel=native: {library.parent} cannot be written ({error.strerror}); point GANLANE_CACHE at a "
            "folder that can, or set env.kernel=torch."
        ) from error


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    """With the types of its functions; a call through ctypes releases the interpreter's lock."""
    pointer, number = ctypes.c_void_p, ctypes.c_long
    for name, pointers in (("decide", 3), ("lane_view", 3), ("mask", 3), ("spawn", 3), ("step", 1), ("start", 1)):
        function = getattr(library, f"ganlane_{name}")
        function.argtypes = [*[pointer] * pointers, number, number]
        function.restype = ctypes.c_int
    return library
