"""Settings of the whole suite."""

import gc
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# Nothing is left in the user's cache; all processes of a run have one, for one built kernel.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["GANLANE_CACHE"] = tempfile.mkdtemp(prefix="ganlane-tests-")


#: There while the kernel is being built.
BUILDING = Path(os.environ["GANLANE_CACHE"], "building")
BUILD = """
import sys
from pathlib import Path

try:
    from ganlane.native.library import load_for, why_not

    # A single highway has a library of its own.
    why_not() or load_for(1)
finally:
    Path(sys.argv[1]).unlink(missing_ok=True)
"""


def pytest_configure(config):
    """With several workers the kernel is built beside their collection, and once for all."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        BUILDING.touch()
        config.kernel_build = subprocess.Popen([sys.executable, "-c", BUILD, str(BUILDING)])


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop():
    # The garbage collector need not look again and again at what was imported.
    gc.collect()
    gc.freeze()
    while "PYTEST_XDIST_WORKER" in os.environ and BUILDING.exists():
        time.sleep(0.1)


def pytest_runtest_setup(item):
    if item.get_closest_marker("kernel") is not None:
        from ganlane.native.library import why_not

        reason = why_not()
        if reason is not None:
            pytest.skip(f"the kernel {reason}")


def pytest_unconfigure(config):
    if not hasattr(config, "workerinput"):
        if hasattr(config, "kernel_build"):
            config.kernel_build.kill()
            config.kernel_build.wait()
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


@pytest.fixture
def no_recordings(empty_folder, monkeypatch):
    """Those of this machine are not found; the empty folder in which they are looked for."""
    monkeypatch.setenv("GANLANE_DATA", str(empty_folder))
    return empty_folder


@pytest.fixture(scope="session")
def three_scenes(tmp_path_factory):
    """A scene CSV of three made-up scenes of 7 s."""
    from reference.scene_csv import write_scene_csv
    from reference.synthetic import synthetic_scenes

    path = tmp_path_factory.mktemp("recordings") / "scenes.csv"
    write_scene_csv(synthetic_scenes(scenes=3, seconds=7.0), path)
    return path


@pytest.fixture
def room_on_disk():
    """No file may grow beyond a size: the same errors as on a full disk, with another errno."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="session")
def us101_scenes():
    """The recordings of US-101, where they are."""
    from ganlane.data import default_scenes, read_scenes
    from ganlane.errors import UserError

    try:
        path = default_scenes()
    except UserError as missing:
        pytest.skip(str(missing))
    return read_scenes(path)
