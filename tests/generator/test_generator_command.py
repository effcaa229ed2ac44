"""``ganlane train_generator`` in process.

On recordings as they are published, with folds and resuming.
"""

from pathlib import Path

import polars as pl
import pytest
from reference.recordings import START_MS, ngsim_rows, portal_csv, raw_text, traffic
from reference.refusals import refusal, results_in

from ganlane.config.run import run_command
from ganlane.data import driving_statistics, read_scenes
from ganlane.generator.checkpoint import load_generator

FEW = [
    "generator.loop.updates=2",
    "generator.loop.evaluate_every=1",
    "generator.batch=4",
    "generator.stride=6",
]
pytestmark = pytest.mark.usefixtures("empty_folder")


def run(*arguments):
    """Results of a fit, and the metadata of its weights."""
    assert run_command("train_generator", [*arguments, *FEW, "hydra.run.dir=fit"]) == 0
    _, metadata = load_generator("fit/generator_paper.safetensors", "paper")
    results = results_in(Path("fit"))
    assert metadata["data"] == results["data"]
    forecasts = {"mean", "single", "best_of_20", "constant_velocity", "idm_own_headway"}
    assert results["ade_m"].keys() == results["fde_m"].keys() == forecasts
    return results, metadata


def test_folds_are_pooled_and_stand_in_the_weights(recordings, capsys):
    results, metadata = run(recordings, "folds=2")
    pooled = results["folds"]["open_loop"]
    assert set(pooled["folds"]) == {"0", "1"}
    assert len(pooled["scenes"]) == 3
    out = capsys.readouterr().out
    assert "idm_own_headway" in out
    assert list(results["scenes"]) == results["data"]["held_out"]
    assert metadata["folds"]["open_loop"]["ade_m"]["mean"] == pytest.approx(pooled["ade_m"]["mean"])
    assert metadata["code"]["version"]
    assert metadata["data"]["validation"]
    statistics = driving_statistics(read_scenes("recordings.csv"))
    assert metadata["driving_statistics"] == statistics.to_dict()


def test_the_periods_of_an_ngsim_file_are_the_scenes_whether_raw_or_prepared():
    scenes = traffic(scenes=3).partition_by("scene", maintain_order=True)
    rows = pl.concat(ngsim_rows(scene, START_MS + 900_000 * k) for k, scene in enumerate(scenes))
    Path("got.csv").write_text(portal_csv(rows))
    raw, metadata = run("data=ngsim", "data.path=got.csv")
    assert metadata["metrics"]["all"] == metadata["metrics"]["us-101-2"]
    data = raw["data"]
    assert data["held_out"] == ["us-101-2"]
    assert (data["file"], data["rows"], data["tracks"]) == ("got.csv", 3 * 9 * 60, 27)
    assert run_command("prepare", ["data=ngsim", "data.path=got.csv", "out=prepared"]) == 0
    prepared, _ = run("data.path=prepared")
    for name in ("ade_m", "fde_m", "scenes"):
        assert raw[name] == prepared[name]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (
            ["data=ngsim", "data.path=one.txt"],
            "recordings of one scene, one-1: one has to be fitted to and another",
        ),
        (["data.path=recordings.csv", "data.held_out=[moon]"], "moon"),
        (["data.path=recordings.csv", "resume=gone"], "resume=gone"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(arguments, part, recordings, capsys):
    Path("one.txt").write_text(raw_text(ngsim_rows(traffic(scenes=1))))
    assert part in refusal(capsys, "train_generator", *arguments, *FEW)
