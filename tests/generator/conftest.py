"""Scenes to fit to."""

import pytest
from reference.recordings import recorded_cars
from reference.scene_csv import write_scene_csv
from reference.synthetic import synthetic_scenes


@pytest.fixture(scope="session")
def scenes():
    """Two of 8 s with seven vehicles."""
    return recorded_cars(scenes=2, vehicles=7, seconds=8.0)


@pytest.fixture
def recordings(empty_folder):
    """A scene CSV of three scenes in the current folder."""
    write_scene_csv(synthetic_scenes(scenes=3, vehicles=4, seconds=6.5), "recordings.csv")
    return "data.path=recordings.csv"
