"""Tries to break the package for minutes or hours, and counts what held: ``python -m tests.trial``.

The tests beside this folder state facts; here random disturbances look for what nobody thought of.
"""

import os
import sys
from pathlib import Path

# The helpers in tests/reference are imported as in the tests.
sys.path.insert(0, str(Path(__file__).parents[1]))
# Before TorchRL is imported: it tells of every replay buffer otherwise.
os.environ.setdefault("RL_LOGGING_LEVEL", "ERROR")
