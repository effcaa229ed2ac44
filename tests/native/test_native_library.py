"""The kernel is built once, wherever a compiler works, and says in one sentence what fails."""

import shutil
import sys
from pathlib import Path

import pytest
from reference import processes
from reference.refusals import user_error

from ganlane import make_env
from ganlane.files import PLACE
from ganlane.native import library


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The kernel of this processor without a checksum, as a compiler leaves it."""
    path = tmp_path_factory.mktemp("plain") / "kernel.so"
    path.write_bytes(Path(library.load()._name).read_bytes()[: -len(PLACE)])
    return path


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("GANLANE_CACHE", str(tmp_path / "cache"))
    library._find.cache_clear()
    yield
    library._find.cache_clear()


@pytest.fixture
def compiler(monkeypatch, tmp_path):
    """Makes a compiler of a shell script, and CXX name it; ``$library`` is :func:`plain`'s."""

    def script(lines, path=None):
        program = tmp_path / "compiler"
        program.write_text(f'#!/bin/sh\nlibrary="{path}"\n{lines}\n')
        program.chmod(0o755)
        monkeypatch.setenv("CXX", str(program))
        monkeypatch.setitem(sys.modules, "ziglang", None)  # not there
        monkeypatch.setattr(library, "best_variant", lambda: "AVX512")
        return program

    return script


#: Copies the library to its last argument, the output, and counts its calls.
WORKS = """for last; do :; done
[ "$last" = --version ] || cp "$library" "$last" && echo "$last" >> "$0.calls"
"""
REFUSES_AVX512 = """case "$*" in *-mavx512f*) echo "error: unknown option" >&2; exit 1;; esac
"""
FAILS = "echo the first line >&2; echo 'x.cpp:1: error: it is full of stars' >&2; exit 1"


@pytest.fixture
def working(compiler, plain):
    """The program of a compiler that works."""
    return compiler(WORKS, plain)


def built():
    return sorted(library.libraries_folder().glob("*.so"))


def calls(program):
    return Path(f"{program}.calls").read_text().count("kernel.so")


def load_again():
    """As another process would."""
    library._find.cache_clear()
    library.load()


@pytest.mark.kernel
def test_it_is_built_once(working):
    library.load()
    load_again()
    assert len(built()) == calls(working) == 1


@pytest.mark.kernel
def test_another_source_is_another_library(monkeypatch, tmp_path, working):
    library.load()
    first, *others = library.SOURCES
    changed = tmp_path / first.name
    changed.write_text(first.read_text() + "\n")
    monkeypatch.setattr(library, "SOURCES", (changed, *others))
    load_again()
    assert len(built()) == 2


def damaged(content):
    """Shorter, without its checksum, with a bit flipped in the code or in the checksum, longer."""
    middle = len(content) // 2
    damages = [content[:middle], content[: -len(PLACE)], content + b"more", b""]
    for place in (middle, len(content) - 30):
        flipped = bytearray(content)
        flipped[place] ^= 1
        damages.append(bytes(flipped))
    return damages


@pytest.mark.kernel
def test_a_damaged_library_is_built_anew_and_never_loaded(working):
    library.load()
    (path,) = built()
    whole = path.read_bytes()
    for count, content in enumerate(damaged(whole), 2):
        path.unlink()  # this process has it in its memory
        path.write_bytes(content)
        load_again()
        assert path.read_bytes() == whole
        assert calls(working) == count


@pytest.mark.kernel
def test_a_damaged_library_of_a_wheel_is_passed_over(monkeypatch, tmp_path, working, plain):
    monkeypatch.setattr(library, "PREBUILT", tmp_path)
    library._prebuilt("AVX512").write_bytes(plain.read_bytes()[:-1000])
    assert library.find().maker == str(working)


@pytest.mark.kernel
def test_a_compiler_that_lacks_an_instruction_set_makes_the_kernel_for_the_next(
    compiler, plain, capsys
):
    program = compiler(REFUSES_AVX512 + WORKS, plain)
    loaded = library.find()
    assert (loaded.variant, loaded.maker) == ("AVX2", str(program))
    told = f"for AVX2 by {program} drives; {program} failed for AVX512 (error: unknown option).\n"
    assert capsys.readouterr().err.endswith(told)
    # A variant that was asked for is that one or none.
    assert isinstance(library.find("AVX512"), str)


@pytest.mark.kernel
@pytest.mark.parametrize(
    "lines", [FAILS, "exit 0", "kill -9 $$", WORKS.replace('cp "$library"', "echo no library >")]
)
def test_the_clang_of_ziglang_is_asked_after_a_compiler_that_fails(
    lines, compiler, working, monkeypatch, tmp_path, capsys
):
    ziglang = working.rename(tmp_path / "ziglang")
    program = compiler(lines)
    monkeypatch.setattr(library, "compilers", lambda: ((str(program),), (str(ziglang),)))
    assert library.find().maker == str(ziglang)
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "cannot be used" not in told


@pytest.mark.kernel
@pytest.mark.parametrize("place", ["file", "/proc/nowhere"])
def test_a_cache_that_cannot_be_used_is_passed_over(place, monkeypatch, tmp_path, working, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GANLANE_CACHE", str(tmp_path / place))
    assert library.find().variant == "AVX512"
    # Loaded from a temporary folder that is gone.
    assert not Path(library.load()._name).exists()
    told = capsys.readouterr().err
    assert f"{place}/native cannot be used" in told
    assert told.endswith("point GANLANE_CACHE at another.\n")


@pytest.mark.kernel
def test_a_library_that_cannot_be_loaded_from_the_cache_is_loaded_from_elsewhere(
    monkeypatch, working
):
    """As where the cache is mounted with ``noexec``."""
    load = library.ctypes.CDLL

    def refuse(path):
        if path.startswith(str(library.libraries_folder())):
            raise OSError(f"{path}: failed to map segment from shared object")
        return load(path)

    monkeypatch.setattr(library.ctypes, "CDLL", refuse)
    for _ in range(2):
        assert library.find().troubles[0].count("failed to map segment") == 1
        library._find.cache_clear()
    assert calls(working) == 1


@pytest.mark.kernel
@pytest.mark.slow
def test_processes_that_build_at_once_do_not_disturb_each_other():
    script = "from ganlane.native import library; library.load('default'); print('loaded')"
    started = [processes.start("-c", script) for _ in range(3)]
    assert [process.communicate()[0] for process in started] == ["loaded\n"] * 3
    assert len(built()) == 1
    assert list(library.libraries_folder().iterdir()) == built()


def test_without_a_compiler_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setattr(library, "compilers", lambda: ())
    with user_error(r"there is no C\+\+ compiler.*g\+\+.*ganlane\[native\].*env\.kernel=torch"):
        library.load()


def test_without_a_compiler_that_works_the_sentence_names_it_and_auto_drives(compiler, capsys):
    program = compiler(FAILS)
    with user_error(r"compiler failed for default .x\.cpp:1: .* full of stars"):
        library.load()
    assert built() == []
    env = make_env("idm", num_envs=2)
    env.rand_step(env.reset())
    told = capsys.readouterr().err
    assert told.startswith("env.kernel=auto: the tensor code, since the native kernel cannot")
    assert str(program) in told
    assert told.count("\n") == 1


def test_a_program_that_cannot_be_run_is_no_compiler(compiler):
    compiler("").write_bytes(b"\0garbage")
    assert "does not run ([Errno 8]" in library.why_not()


def test_clang_of_the_package_ziglang_comes_after_the_systems(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(library.importlib.util, "find_spec", lambda name: name)
    zig = (sys.executable, "-m", "ziglang", "c++")
    assert library.compilers() == (zig,)
    # Else it would compile for the processor that it runs on, and a wheel is for others too.
    assert "-mcpu=baseline" in library._command("default", zig)
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    assert [command[0] for command in library.compilers()][1:] == [sys.executable]


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


@pytest.mark.kernel
def test_the_library_of_a_wheel_is_taken_and_needs_no_compiler(
    monkeypatch, tmp_path, compiler, plain
):
    compiler(REFUSES_AVX512 + WORKS, plain)
    monkeypatch.setattr(library.platform, "machine", lambda: "x86_64")
    paths, troubles = library.build_all(tmp_path / "wheel")
    assert [path.name.split("-")[1] for path in paths] == ["avx2", "default"]
    assert len(troubles) == 1
    monkeypatch.setattr(library, "PREBUILT", tmp_path / "wheel")
    monkeypatch.setattr(library, "compilers", lambda: ())
    assert library.why_not() is None
    assert library.load()._name == str(paths[0])
    assert not built()


def test_a_wheel_whose_compiler_fails_has_no_kernel(tmp_path, compiler):
    compiler(FAILS)
    paths, troubles = library.build_all(tmp_path / "wheel")
    assert paths == []
    assert "failed for default (x.cpp:1: error: it is full of stars)" in troubles[-1]
