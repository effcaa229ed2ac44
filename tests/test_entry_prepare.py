"""``ganlane prepare`` from end to end, on recordings made up, in process.

And on to a generator that drives.
"""

import json
from functools import partial
from pathlib import Path

import pytest
from reference.refusals import last_path
from reference.scene_csv import write_scene_csv
from reference.synthetic import SyntheticTraffic, synthetic_scenes

from ganlane.config.run import run_command
from ganlane.data import read_scenes

main = partial(run_command, "prepare")


@pytest.fixture(autouse=True)
def here(empty_folder, monkeypatch):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    return empty_folder


def results(out: str) -> dict:
    return json.loads(last_path(out).read_text())


def write_csv(path: Path, **more) -> Path:
    write_scene_csv(synthetic_scenes(SyntheticTraffic(**more)), path)
    return path


def test_a_scene_csv_becomes_parquet_and_figures(here, capsys):
    write_csv(here / "mine.csv", seconds=8.0)
    assert main(["data.path=mine.csv", "out=mine"]) == 0
    numbers = results(capsys.readouterr().out)
    assert numbers["rows"] == {
        "read": 1920,
        "kept": 1920,
        "dropped": {},
        "written": 1920,
    }
    assert numbers["acceleration_raw"]["count"] > numbers["acceleration_smoothed"]["count"] > 0
    names = {
        "speed",
        "headway",
        "time_headway",
        "gap",
        "lane_changes",
        "wall_s",
        "code",
    }
    assert names <= numbers.keys()
    assert read_scenes("mine").equals(read_scenes("mine.csv"))
