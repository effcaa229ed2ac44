"""Tries to break the package, part by part, and counts what held: ``python -m benchmarks.torture``."""
