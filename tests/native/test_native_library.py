"""The kernel is built once, wherever a compiler is, and says in one sentence what is missing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ganlane.errors import UserError
from ganlane.native import library

needs_compiler = pytest.mark.skipif(library.why_not() is not None, reason="no C++ compiler")


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("GANLANE_CACHE", str(tmp_path / "cache"))
    # Nothing is driven here: the compiler need not optimise.
    monkeypatch.setattr(
        library, "FLAGS", tuple("-O0" if flag == "-O3" else flag for flag in library.FLAGS)
    )
    library._load.cache_clear()
    yield
    library._load.cache_clear()


def built() -> list[Path]:
    return sorted(library.libraries_folder().glob("*.so"))


@needs_compiler
def test_it_is_built_once():
    library.load("default")
    first = [path.stat().st_mtime_ns for path in built()]
    library._load.cache_clear()
    library.load("default")
    assert len(first) == 1
    assert [path.stat().st_mtime_ns for path in built()] == first


@needs_compiler
def test_another_source_is_another_library(monkeypatch, tmp_path):
    library.load("default")
    for source in library.SOURCES:
        (tmp_path / source.name).write_text(source.read_text() + "\n")
    monkeypatch.setattr(
        library, "SOURCES", tuple(tmp_path / source.name for source in library.SOURCES)
    )
    library._load.cache_clear()
    library.load("default")
    assert len(built()) == 2


@needs_compiler
@pytest.mark.slow
def test_processes_that_build_at_once_do_not_disturb_each_other():
    script = "from ganlane.native import library; library.load('default'); print('loaded')"
    processes = [
        subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, env=os.environ)
        for _ in range(3)
    ]
    assert [process.communicate()[0] for process in processes] == [b"loaded\n"] * 3
    assert len(built()) == 1
    assert [path.name for path in library.libraries_folder().iterdir()] == [built()[0].name]


def test_without_a_compiler_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setattr(library, "compiler_command", lambda: None)
    with pytest.raises(
        UserError, match=r"needs a C\+\+ compiler.*g\+\+.*ganlane\[native\].*env\.kernel=torch"
    ):
        library.load()


def test_a_compiler_that_fails_is_named(monkeypatch, tmp_path):
    broken = tmp_path / "broken"
    broken.write_text("#!/bin/sh\necho it is full of stars >&2; exit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CXX", str(broken))
    with pytest.raises(UserError, match=r"broken failed \(it is full of stars\)"):
        library.load()
    assert built() == []


@needs_compiler
def test_a_cache_folder_that_cannot_be_written_is_named(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GANLANE_CACHE", str(tmp_path / "file"))
    with pytest.raises(UserError, match=r"file/native cannot be written.*GANLANE_CACHE"):
        library.load()


def test_clang_of_the_package_ziglang_is_found_where_there_is_no_other(monkeypatch):
    monkeypatch.setattr(library.shutil, "which", lambda name: None)
    monkeypatch.setattr(library.importlib.util, "find_spec", lambda name: name)
    assert library.compiler_command() == (sys.executable, "-m", "ziglang", "c++")


V3 = "avx2 bmi1 bmi2 f16c fma movbe"
V4 = f"{V3} avx512f avx512bw avx512cd avx512dq avx512vl"


@pytest.mark.parametrize(
    ("machine", "flags", "variant"),
    [
        ("riscv64", V4, "default"),
        ("arm64", V4, "default"),
        ("x86_64", "sse2", "default"),
        ("x86_64", "avx2", "default"),
        ("x86_64", V3, "AVX2"),
        ("x86_64", V4, "AVX512"),
    ],
)
def test_a_processor_gets_the_fastest_variant_that_it_runs(
    monkeypatch, tmp_path, machine, flags, variant
):
    (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nflags\t\t: fpu {flags} sse\n")
    monkeypatch.setattr(library.platform, "machine", lambda: machine)
    monkeypatch.setattr(library, "CPU_INFO", tmp_path / "cpuinfo")
    assert library.best_variant() == variant


@needs_compiler
def test_the_library_of_a_wheel_is_taken_and_needs_no_compiler(monkeypatch, tmp_path):
    # the others take seconds
    monkeypatch.setattr(library, "VARIANTS", {"default": library.VARIANTS["default"]})
    (built_library,) = library.build_all(tmp_path / "wheel")
    monkeypatch.setattr(library, "PREBUILT", built_library.parent)
    monkeypatch.setattr(library, "compiler_command", lambda: None)
    monkeypatch.setattr(library, "best_variant", lambda: "default")
    assert library.why_not() is None
    assert library.load()._name == str(built_library)
    assert not built()


def test_the_library_of_another_versions_sources_is_not_taken(monkeypatch, tmp_path):
    ours = library._prebuilt("default")
    other = tmp_path / "other.cpp"
    other.write_text("other")
    monkeypatch.setattr(library, "SOURCES", (other,))
    assert library._prebuilt("default").name != ours.name
