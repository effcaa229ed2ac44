"""Scenes to fit to."""

import pytest
from reference.small_networks import recorded_scenes


@pytest.fixture(scope="session")
def scenes():
    return recorded_scenes()
