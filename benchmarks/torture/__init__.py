"""Tries to break the package, part by part, and counts what held: ``python -m benchmarks.torture``."""

import os

# Before TorchRL is imported: it tells of every replay buffer otherwise.
os.environ.setdefault("RL_LOGGING_LEVEL", "ERROR")
