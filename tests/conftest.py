"""Settings of the whole suite; makes the plain helper modules of ``tests/reference`` importable."""

from __future__ import annotations

import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

# Time limits per example fail on a busy machine, and a suite should find the same faults in every run.
settings.register_profile("ganlane", deadline=None, derandomize=True, database=None)
settings.load_profile("ganlane")
