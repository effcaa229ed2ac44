"""What ganlane prints goes to a reader who leaves, or to a full disk: one status, no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: ``ganlane`` itself, a command without keys, and one with keys, which names itself.
LINES = [["--help"], ["doctor", "--help"], ["train", "--help"]]


def started(arguments, **options):
    """``ganlane`` in a process of its own."""
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    line = [sys.executable, "-m", "ganlane", *arguments]
    return subprocess.Popen(line, env=environment, stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("arguments", LINES, ids=" ".join)
def test_a_full_disk_ends_it_with_one_sentence(arguments):
    with open("/dev/full", "w") as full, started(arguments, stdout=full) as process:
        _, err = process.communicate(timeout=120)
    name = "ganlane train" if "train" in arguments else "ganlane"
    told = "a file or standard output: No space left on device; make room there, or write to another disk.\n"
    assert err == f"{name}: {told}"
    assert process.returncode == 2


@pytest.mark.skipif(sys.platform == "win32", reason="pipes end otherwise there")
@pytest.mark.parametrize("arguments", LINES, ids=" ".join)
def test_a_reader_who_leaves_ends_it_in_silence(arguments):
    reading, writing = os.pipe()
    os.close(reading)
    with started(arguments, stdout=writing) as process:
        os.close(writing)
        _, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (141, "")
