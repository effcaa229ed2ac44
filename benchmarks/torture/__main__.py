"""Tries to break the package, and counts what held.

    python -m benchmarks.torture                                  a cut of all parts, about ten minutes
    python -m benchmarks.torture kill --runs 50 --minutes 15
"""
