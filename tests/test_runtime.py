"""Memory, streams and statuses of a process.

A reader who leaves, a full disk, streams that the shell has closed.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from reference.processes import run, start
from reference.refusals import is_one_sentence

from ganlane import runtime


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="glibc's allocator is on Linux alone"
)
def test_a_process_that_keeps_its_memory_is_not_given_new_pages_at_every_step():
    # In a process of its own: here other tests have set the allocator, and threads share it.
    program = """
import resource
from ganlane import runtime

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        first = bytearray(8_000_000)
        second = bytes(first)
        del first, second
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

without = faults()
possible = runtime.keep_freed_memory()
faults()
print(possible, without, faults())
"""
    finished = run("-c", program)
    assert finished.returncode == 0, finished.stderr
    possible, returning, keeping = finished.stdout.split()
    if possible == "False":
        pytest.skip("this libc has no mallopt")
    assert int(keeping) < int(returning) / 10


def test_elsewhere_nothing_happens(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not runtime.keep_freed_memory()


def test_a_command_runs_without_the_streams_that_the_shell_has_closed():
    line = f"exec {sys.executable} -m ganlane --help 0>&- 1>&- 2>&-"
    assert subprocess.run(["bash", "-c", line], check=False).returncode == 0


def test_a_command_without_docstrings_is_refused_in_one_sentence(tmp_path):
    finished = run("-OO", "-m", "ganlane", "evaluate", cwd=tmp_path)
    assert finished.returncode == 2
    assert finished.stdout == ""
    assert is_one_sentence(finished.stderr, "evaluate")
    assert "python -OO" in finished.stderr
    assert list(tmp_path.iterdir()) == []


def test_without_docstrings_help_still_lists_the_keys():
    finished = run("-OO", "-m", "ganlane", "prepare", "--help")
    assert (finished.returncode, finished.stderr) == (0, "")
    assert "held_out" in finished.stdout


@pytest.mark.skipif(
    sys.version_info[:3] == (3, 13, 0),
    reason="without a working directory Python 3.13.0 cannot import its own socket",
)
@pytest.mark.parametrize(
    ("options", "message"),
    [((), "working directory is gone"), (("-OO",), "removes the docstrings")],
)
def test_the_doctor_reports_in_one_sentence_that_nothing_can_run(options, message, tmp_path):
    folder = tmp_path / "removed"
    folder.mkdir()
    code = f"import os; os.rmdir({str(folder)!r}); from ganlane.doctor import main; main([])"
    finished = run(*options, "-c", code, cwd=folder)
    assert message in finished.stderr
    assert finished.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("command", ["", "train"])
def test_a_full_disk_ends_it_with_one_sentence_that_names_the_command(command):
    with open("/dev/full", "w") as full:
        finished = run("-m", "ganlane", *command.split(), "--help", stdout=full)
    name = f"ganlane {command}".rstrip()
    assert finished.stderr == (
        f"{name}: a file or standard output: No space left on device; "
        "check the path, its permissions and the space there.\n"
    )
    assert finished.returncode == 2


@pytest.mark.skipif(sys.platform == "win32", reason="pipes end otherwise there")
@pytest.mark.parametrize("command", ["", "train"])
def test_a_reader_who_leaves_ends_it_in_silence(command):
    reading, writing = os.pipe()
    os.close(reading)
    with start("-m", "ganlane", *command.split(), "--help", stdout=writing) as process:
        os.close(writing)
        _, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (141, "")
