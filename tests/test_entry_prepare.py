"""``ganlane prepare`` from end to end, on recordings made up, in process."""

import json

from reference.refusals import last_path
from reference.scene_csv import write_scene_csv
from reference.synthetic import synthetic_scenes

from ganlane.config.run import run_command
from ganlane.data import read_scenes


def test_a_scene_csv_becomes_parquet_and_figures(empty_folder, monkeypatch, capsys):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    write_scene_csv(synthetic_scenes(seconds=8.0), "mine.csv")
    assert run_command("prepare", ["data.path=mine.csv", "out=mine"]) == 0
    numbers = json.loads(last_path(capsys.readouterr().out).read_text())
    assert numbers["rows"] == {"read": 1920, "kept": 1920, "dropped": {}, "written": 1920}
    assert numbers["acceleration_raw"]["count"] > numbers["acceleration_smoothed"]["count"] > 0
    names = {"speed", "headway", "time_headway", "gap", "lane_changes", "wall_s", "code"}
    assert names <= numbers.keys()
    assert read_scenes("mine").equals(read_scenes("mine.csv"))
