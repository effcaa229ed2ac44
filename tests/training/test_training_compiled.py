"""env.compile=true: a run that is stopped goes on, in a process of its own, to the weights of one in a piece."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import entry_tiny
import pytest
import torch

import ganlane
from ganlane.agents import read_agent
from ganlane.runtime import COMPILERS
from ganlane.training.checkpoint import LAST, load_checkpoint
from ganlane.training.phases import (
    AGENT_FILE,
)

TINY = [*entry_tiny.TINY, "logger.progress=false"]

#: A phase alone, without the evaluation that a command makes at its end: that would compile as much again.
SCRIPT = """
import sys
from pathlib import Path
from ganlane.config.command_line import check
from ganlane.training.phases import phases_of, run_phase

if __name__ == "__main__":
    folder, resume, *told = sys.argv[1:]
    config = check("train", told).config
    run_phase(config, phases_of(config, Path(folder))[0], resume or None)
"""
#: Decisions that nobody waits for.
TOO_LONG = 64_000


def begin(folder: Path, total: int, resume: Path | str = "") -> subprocess.Popen:
    """A training run in ``folder``, under way; what the compiler leaves is shared by the runs beside it."""
    own = {
        "PYTHONPATH": str(Path(ganlane.__file__).parents[1]),
        "TORCHINDUCTOR_CACHE_DIR": str(folder.parent / "cache"),
    }
    command = [
        sys.executable,
        "-c",
        SCRIPT,
        str(folder),
        str(resume),
        *TINY,
        "env.compile=true",
        f"total_decisions={total}",
    ]
    return subprocess.Popen(command, env={**os.environ, **own, "OMP_NUM_THREADS": "1"})


def stop_after_a_row(run: subprocess.Popen, metrics: Path) -> None:
    """SIGTERM in the middle: in the loop, some steps after the first figures."""
    while run.poll() is None and not (metrics.is_file() and len(metrics.read_text().splitlines()) > 1):
        time.sleep(0.1)
    run.send_signal(signal.SIGTERM)


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, COMPILERS)), reason="no C++ compiler")
def test_a_compiled_run_stopped_and_resumed_ends_with_the_same_bits(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    first = begin(parts, TOO_LONG)
    stop_after_a_row(first, parts / "metrics.csv")
    assert first.wait() == 0
    reached = load_checkpoint(parts / LAST)["counters"]["decisions"]
    assert 160 <= reached < TOO_LONG
    assert not (parts / AGENT_FILE).exists()
    assert begin(parts, reached + 480, resume=parts / LAST).wait() == 0
    assert begin(whole, reached + 480).wait() == 0
    one, other = (read_agent(folder / AGENT_FILE)[0] for folder in (parts, whole))
    assert all(torch.equal(one[name], other[name]) for name in one)
