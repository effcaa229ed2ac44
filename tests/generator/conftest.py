"""Tests of the generator leave the user's cache alone."""

import pytest

from ganlane.generator.windows import CACHE_VARIABLE


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    """Nothing is kept unless a test names a folder."""
    monkeypatch.setenv(CACHE_VARIABLE, "")
