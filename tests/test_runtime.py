import subprocess
import sys
from pathlib import Path

import pytest

from ganlane import runtime

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator is on Linux alone")
def test_a_process_that_keeps_its_memory_is_not_given_new_pages_at_every_step():
    torch = pytest.importorskip("torch")
    import resource

    def faults() -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(20):
            a = torch.zeros(2_000_000)
            a = (a + 1.0) * 2.0
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    without = faults()
    if not runtime.keep_freed_memory():
        pytest.skip("this libc has no mallopt")
    faults()
    assert faults() < max(without, 1) / 10


def test_elsewhere_nothing_happens(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not runtime.keep_freed_memory()


def test_the_peak_stays_when_memory_is_given_back():
    torch = pytest.importorskip("torch")
    before = runtime.peak_resident_bytes()
    if before is None:
        pytest.skip("this system does not report a process's peak memory")
    size = before + 50_000_000
    held = torch.ones(size, dtype=torch.uint8)
    assert runtime.peak_resident_bytes() >= size
    del held
    assert runtime.peak_resident_bytes() >= size


@pytest.mark.parametrize("closed", ["1", "2", "0 1 2"])
def test_a_command_runs_without_the_streams_that_the_shell_has_closed(closed):
    shut = " ".join(f"{number}>&-" for number in closed.split())
    done = subprocess.run(
        ["bash", "-c", f"exec {sys.executable} -m ganlane --help {shut}"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_a_command_without_docstrings_is_refused_in_one_sentence():
    command = [sys.executable, "-OO", "-m", "ganlane", "evaluate"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("ganlane evaluate: python -OO")
    assert done.stderr.count("\n") == 1


def test_without_docstrings_help_still_lists_the_keys():
    command = [sys.executable, "-OO", "-m", "ganlane", "prepare", "--help-all"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "held_out" in done.stdout


def doctor(here, *options):
    """What the doctor says, with Python's ``options``, in the folder ``here``, which is removed first."""
    line = [
        sys.executable,
        *options,
        "-c",
        f"import os; os.rmdir({str(here)!r}); from ganlane.doctor import main; main([])",
    ]
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    return subprocess.run(line, cwd=here, env=environment, capture_output=True, text=True, timeout=120).stderr


@pytest.mark.parametrize(
    ("options", "told"), [((), "working directory is gone"), (("-OO",), "removes the docstrings")]
)
def test_a_process_in_which_nothing_can_run_is_told_in_one_sentence(options, told, tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    said = doctor(here, *options)
    assert told in said
    assert said.count("\n") == 1
