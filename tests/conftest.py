"""Settings of the whole suite; makes the plain helper modules of ``tests/reference`` importable."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

# Nothing is left in the user's cache.
os.environ["GANLANE_CACHE"] = ""

# The batches of tests are small: one thread is fastest, and the suite runs in two processes.
torch.set_num_threads(1)

# Time limits per example fail on a busy machine, and a suite should find the same faults in every
# run.
settings.register_profile("ganlane", deadline=None, derandomize=True, database=None)
settings.load_profile("ganlane")


@pytest.fixture
def empty_folder(tmp_path, monkeypatch):
    """The working folder: an empty one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
