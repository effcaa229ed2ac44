"""``ganlane train_generator`` from end to end, on recordings made up, in process."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.realism.starts import check_folds_cover, fold_weights
from ganlane.train_generator import main

FEW = ["generator.loop.updates=2", "generator.loop.evaluate_every=1", "generator.batch=4"]


@pytest.fixture
def recordings(tmp_path, monkeypatch):
    """A scene CSV in the current folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "recordings.csv"
    write_scene_csv(synthetic_scenes(SyntheticTraffic()), path)
    return path


def test_errors_stand_beside_constant_velocity(recordings, capsys):
    assert main([f"data.path={recordings}", *FEW]) == 0
    out = capsys.readouterr().out
    assert "constant_velocity" in out
    results = json.loads(Path(out.splitlines()[-1].removeprefix("results: ")).read_text())
    kinds = {"mean", "single", "best_of_20", "constant_velocity"}
    assert results["ade_m"].keys() == results["fde_m"].keys() == kinds
    assert list(results["scenes"]) == results["data"]["held_out"]
    assert not set(results["data"]["held_out"]) & set(results["data"]["fitted"])


def test_the_folds_generators_are_kept_and_cover_every_scene(recordings, capsys):
    frame = synthetic_scenes(SyntheticTraffic(scenes=3, vehicles=5, seconds=6.5))
    write_scene_csv(frame, recordings)
    assert main([f"data.path={recordings}", *FEW, "folds=3"]) == 0
    folder = Path(capsys.readouterr().out.splitlines()[-1].removeprefix("results: ")).parent
    paths = [folder / f"generator_paper_fold_{number}.safetensors" for number in (1, 2, 3)]
    folds = fold_weights(paths)
    assert [weights["paper"] for weights in folds.values()] == paths
    check_folds_cover(list(folds), sorted(frame["scene"].unique()))


def broken(path: Path, how: str) -> None:
    table = pl.read_csv(path)
    if how == "column":
        table = table.drop("v")
    elif how == "text":
        table = table.with_columns(x=pl.lit("far away"))
    table.write_csv(path)


@pytest.mark.parametrize(("how", "part"), [("column", "v"), ("text", "far away")])
def test_damaged_recordings_are_refused_by_column(how, part, recordings, capsys, tmp_path):
    broken(recordings, how)
    assert main([f"data.path={recordings}", *FEW]) == 2
    err = capsys.readouterr().err
    assert str(recordings) in err
    assert part in err
    assert err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["recordings.csv"]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["data.path=gone.csv"], "gone.csv: no such file"),
        (["data.path=recordings.csv", "data.held_out=[moon]"], "moon"),
    ],
)
def test_what_is_not_there_is_named(arguments, part, recordings, capsys, tmp_path):
    assert main([*arguments, *FEW]) == 2
    assert part in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["recordings.csv"]
