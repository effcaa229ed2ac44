"""Marks that tests of several files have."""

import os

import pytest

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


def slow(*values):
    """Values of a parametrised test that take minutes."""
    return pytest.param(*values, marks=pytest.mark.slow)
