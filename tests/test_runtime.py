import subprocess
import sys
from pathlib import Path

import pytest
import torch

from ganlane import runtime

ROOT = Path(__file__).resolve().parents[1]


def run(*command, **options):
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator is on Linux alone")
def test_a_process_that_keeps_its_memory_is_not_given_new_pages_at_every_step():
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
    redirections = " ".join(f"{number}>&-" for number in closed.split())
    finished = run("bash", "-c", f"exec {sys.executable} -m ganlane --help {redirections}")
    assert (finished.returncode, finished.stderr) == (0, "")


def test_a_command_without_docstrings_is_refused_in_one_sentence():
    finished = run(sys.executable, "-OO", "-m", "ganlane", "evaluate")
    assert finished.returncode == 2
    assert finished.stderr.startswith("ganlane evaluate: python -OO")
    assert finished.stderr.count("\n") == 1


def test_without_docstrings_help_still_lists_the_keys():
    finished = run(sys.executable, "-OO", "-m", "ganlane", "prepare", "--help-all")
    assert (finished.returncode, finished.stderr) == (0, "")
    assert "held_out" in finished.stdout


@pytest.mark.parametrize(
    ("options", "message"), [((), "working directory is gone"), (("-OO",), "removes the docstrings")]
)
def test_the_doctor_reports_in_one_sentence_that_nothing_can_run(options, message, tmp_path):
    folder = tmp_path / "removed"
    folder.mkdir()
    code = f"import os; os.rmdir({str(folder)!r}); from ganlane.doctor import main; main([])"
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    finished = run(sys.executable, *options, "-c", code, cwd=folder, env=environment, timeout=120)
    assert message in finished.stderr
    assert finished.stderr.count("\n") == 1
