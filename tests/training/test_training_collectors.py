"""Runs that are killed."""

import os
import signal
import time

import pytest
import torch
from training.small_runs import agent, road, settings, train

from ganlane.training import checkpoint
from ganlane.training.checkpoint import LAST, load_checkpoint


def train_until_killed(folder):
    """A run without an end, which saves whenever it may, in a child; its process."""
    child = os.fork()
    if child == 0:
        try:
            checkpoint.PATIENCE = 0.0
            train(road(8), agent(), settings(10**9, checkpoint_every_s=0.0), folder)
        finally:
            os._exit(1)
    return child


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_run_killed_at_any_moment_is_resumed_to_the_same_weights(tmp_path):
    """Killed a tenth of a second after its first checkpoint; other moments are in tests/trial."""
    folder = tmp_path / "parts"
    last = folder / LAST
    child = train_until_killed(folder)
    while not last.exists():
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
        time.sleep(0.01)
    time.sleep(0.11)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    more = settings(int(load_checkpoint(last)["counters"]["decisions"]) + 160)
    resumed = agent(seed=5)
    whole = agent()
    train(road(8), resumed, more, folder, resume=last)
    train(road(8), whole, more, tmp_path / "whole")
    for one, other in zip(whole.weights().values(), resumed.weights().values(), strict=True):
        assert torch.equal(one, other)
