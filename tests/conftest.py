"""Settings of the whole suite; makes the plain helper modules of ``tests/reference`` importable."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

# Nothing is left in the user's cache; all processes of a run have one, for one built kernel.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["GANLANE_CACHE"] = tempfile.mkdtemp(prefix="ganlane-tests-")


def pytest_unconfigure(config):
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ["GANLANE_CACHE"], ignore_errors=True)


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
