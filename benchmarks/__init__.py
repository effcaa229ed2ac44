"""Benchmarks that are run from the repository root and do not ship with the package."""
