"""What a check of the command line has to load."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_roads_keys_are_checked_without_torchrl():
    program = (
        "import sys; from ganlane.config.env import EnvConfig; EnvConfig().episode_parameters(); "
        "print([m for m in ('torchrl', 'tensordict', 'ganlane.env', 'ganlane.traffic') if m in sys.modules])"
    )
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, env=environment
    )
    assert done.stdout == "[]\n", done.stderr


def test_parameters_are_declared_without_torch():
    """So that a mistyped key is reported before torch, which takes seconds, is loaded."""
    names = sorted(path.stem for path in (ROOT / "ganlane" / "parameters").glob("*.py"))
    program = (
        f"import importlib, sys; [importlib.import_module('ganlane.parameters.' + n) for n in {names[1:]}]; "
        "print([m for m in ('torch', 'hydra', 'omegaconf', 'ganlane.sim') if m in sys.modules])"
    )
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, env=environment
    )
    assert done.stdout == "[]\n", done.stderr
