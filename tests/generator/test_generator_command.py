"""``ganlane train_generator`` with folds, resuming and ablations, on recordings made up, in process."""

import json
from pathlib import Path

import pytest

import ganlane.evaluation
import ganlane.generator
from ganlane.config.folders import cleared_after_mistakes
from ganlane.data import SyntheticTraffic, synthetic_scenes, write_scene_csv
from ganlane.generator.checkpoint import load_generator
from ganlane.train_generator import main

FEW = ["generator.loop.updates=4", "generator.loop.evaluate_every=4", "generator.batch=4", "generator.stride=6"]


@pytest.fixture
def recordings(tmp_path, monkeypatch):
    """A scene CSV in the current folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "recordings.csv"
    write_scene_csv(synthetic_scenes(SyntheticTraffic(scenes=4, vehicles=5, seconds=4.0)), path)
    return f"data.path={path}"


def run(capsys, *arguments) -> tuple[str, Path, dict]:
    """What a run printed, its folder and its results."""
    assert main(list(arguments)) == 0
    out = capsys.readouterr().out
    path = Path(out.splitlines()[-1].removeprefix("results: "))
    return out, path.parent, json.loads(path.read_text())


def test_errors_pooled_over_folds_stand_in_results_and_in_the_weights(recordings, capsys):
    out, folder, results = run(capsys, recordings, "folds=2", *FEW)
    pooled = results["folds"]["open_loop"]
    assert set(pooled["folds"]) == {"0", "1"}
    assert len(pooled["scenes"]) == 4
    assert "ridge" in out
    _, metadata = load_generator(folder / "generator_paper.safetensors", "paper")
    assert metadata["folds"]["open_loop"]["ade_m"]["mean"] == pytest.approx(pooled["ade_m"]["mean"])
    assert metadata["config"]["seed"] == 0
    assert metadata["code"]["version"]
    assert metadata["data"]["validation"]


def test_an_earlier_runs_fits_are_not_fitted_again(recordings, capsys):
    _, folder, first = run(capsys, recordings, "folds=2", *FEW)
    kept = {path: path.stat().st_mtime_ns for path in (folder / "fits").iterdir()}
    _, other, again = run(capsys, recordings, "folds=2", f"resume={folder}", "hydra.run.dir=again", *FEW)
    assert other != folder
    assert again["folds"] == first["folds"]
    assert again["ade_m"] == first["ade_m"]
    assert {path: path.stat().st_mtime_ns for path in (folder / "fits").iterdir()} == kept


def test_ablations_stand_in_the_results(recordings, capsys):
    out, _, results = run(capsys, recordings, "ablations=true", *FEW)
    assert "without pooling" in out
    assert {"p_l = 4", "p_l = 12", "without pooling"} <= set(results["ablations"])


@pytest.mark.parametrize(
    ("argument", "part"),
    [("folds=1", "folds=1"), ("folds=9", "folds=9"), ("resume=gone", "resume=gone"), ("folds=-1", "folds")],
)
def test_mistakes_are_told_in_one_sentence(argument, part, recordings, capsys, tmp_path):
    assert main([recordings, argument, *FEW]) == 2
    err = capsys.readouterr().err
    assert part in err
    assert err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["recordings.csv"]


def test_what_was_fitted_stays_where_a_later_step_fails(recordings, capsys, monkeypatch, tmp_path):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied", "results.json")

    monkeypatch.setattr(ganlane.evaluation, "write_results", refuse)
    assert main([recordings, *FEW]) == 2
    assert "results.json" in capsys.readouterr().err
    assert len(list(tmp_path.rglob("fits/*.pt"))) == 1
    assert len(list(tmp_path.rglob("generator_paper.safetensors"))) == 1


@pytest.mark.parametrize("kept", ["fits/*.pt", "generator_*.safetensors"])
def test_each_of_the_two_is_kept_by_itself(kept, tmp_path):
    file = tmp_path / "run" / kept.replace("*", "paper")

    def fit():
        file.parent.mkdir(parents=True)
        file.touch()
        raise OSError("full")

    with pytest.raises(OSError, match="full"), cleared_after_mistakes(tmp_path / "run"):
        fit()
    assert file.is_file()


def test_too_many_folds_are_refused_before_ablations_are_fitted(recordings, capsys, monkeypatch):
    fitted = []
    monkeypatch.setattr(ganlane.generator, "ablate", lambda *given: fitted.append(given))
    assert main([recordings, "ablations=true", "folds=9", *FEW]) == 2
    assert "folds=9" in capsys.readouterr().err
    assert not fitted
