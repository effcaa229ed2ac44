"""Runs that are killed."""

import subprocess
import sys
import time
from pathlib import Path

from training.small_runs import agent, road, same, settings, train

from ganlane.training.checkpoint import (
    load_checkpoint,
)

KILLED = """
import sys
import torch
torch.set_num_threads(1)
sys.path[:0] = [{tests!r}]
from training.small_runs import agent, road, settings, train
import ganlane.training.checkpoint as checkpoint
checkpoint.PATIENCE = 0.0
train(road(8), agent(), settings(10**9, checkpoint_every_s=0.0), {folder!r})
"""


def test_a_run_killed_at_any_moment_is_resumed_to_the_same_weights(tmp_path):
    """Killed a tenth of a second after its first checkpoint; other moments are in tests/trial."""
    folder = tmp_path / "parts"
    tests = Path(__file__).resolve().parent.parent
    script = KILLED.format(tests=str(tests), folder=str(folder))
    last = folder / "checkpoints" / "last.pt"
    line = [sys.executable, "-c", script]
    with subprocess.Popen(line, cwd=tests.parent) as process:
        while not last.exists():
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(0.11)
        process.kill()
    more = settings(int(load_checkpoint(last)["counters"]["decisions"]) + 400)
    resumed = agent(seed=5)
    whole = agent()
    train(road(8), resumed, more, folder, resume=last)
    train(road(8), whole, more, tmp_path / "whole")
    assert same(whole, resumed)
