"""``ganlane train_generator`` on recordings as they are published: read as ``ganlane prepare`` reads them."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest
from reference.file_server import Server
from reference.recordings import START_MS, ngsim_rows, portal_csv, raw_text, traffic, write_highd

from ganlane.generator.checkpoint import load_generator
from ganlane.prepare import main as prepare
from ganlane.train_generator import main

FEW = ["generator.loop.updates=2", "generator.loop.evaluate_every=1", "generator.batch=4", "hydra.run.dir=fit"]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Runs in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    return tmp_path


def three_periods() -> str:
    """A portal CSV of three recordings."""
    scenes = traffic(scenes=3).partition_by("scene", maintain_order=True)
    return portal_csv(pl.concat(ngsim_rows(scene, START_MS + 900_000 * k) for k, scene in enumerate(scenes)))


def fitted(*arguments: str) -> dict:
    """Results of a fit in the folder ``fit``, whose weights can be loaded."""
    assert main([*arguments, *FEW]) == 0
    _, metadata = load_generator(Path("fit") / "generator_paper.safetensors", "paper")
    results = json.loads((Path("fit") / "results.json").read_text())
    assert metadata["data"] == results["data"]
    assert set(results["ade_m"]) == {"mean", "single", "best_of_20", "constant_velocity"}
    return results


def test_the_periods_of_an_ngsim_file_are_the_scenes(here):
    (here / "portal.csv").write_text(three_periods())
    data = fitted("data=ngsim", "data.path=portal.csv")["data"]
    assert (data["fitted"], data["validation"], data["held_out"]) == (["us-101-3"], ["us-101-1"], ["us-101-2"])
    assert (data["rows"], data["tracks"]) == (3 * 9 * 60, 27)


def test_the_directions_of_highd_are_the_scenes(here):
    write_highd(here / "highd")
    data = fitted("data=highd", "data.path=highd", "data.held_out=[highd-01-upper]")["data"]
    assert (data["fitted"], data["held_out"]) == (["highd-01-lower"], ["highd-01-upper"])
    assert (data["rows"], data["tracks"]) == (4 * 80, 4)


def test_what_a_fit_reads_is_what_prepare_writes(here):
    (here / "portal.csv").write_text(three_periods())
    direct = fitted("data=ngsim", "data.path=portal.csv")
    assert prepare(["data=ngsim", "data.path=portal.csv", "out=prepared"]) == 0
    by_way_of_parquet = fitted("data.path=prepared")
    for name in ("ade_m", "fde_m", "scenes"):
        assert direct[name] == by_way_of_parquet[name]


def test_a_users_csv_may_have_its_own_order_of_columns_and_more_of_them(here):
    lines = ["note,lane,vehicle,scene,frame,x,y,v,width,length"]
    for scene, speed in (("morning", 20), ("noon", 22)):
        for vehicle, lane in ((7, 1), (3, 2)):
            for frame in range(100, 140):
                x = 30 * vehicle + speed * (frame - 100) / 10
                lines.append(f"mine,{lane},{vehicle},{scene},{frame},{x},{4 - 4 * lane},{speed},2,5")
    (here / "mine.csv").write_text("\n".join(lines) + "\n")
    results = fitted("data.path=mine.csv", "data.held_out=[noon]")
    assert (results["data"]["fitted"], results["data"]["held_out"]) == (["morning"], ["noon"])
    # Everybody holds his speed and his lane.
    assert results["ade_m"]["constant_velocity"] == pytest.approx(0.0, abs=1e-3)


def test_a_file_is_fetched_first_where_asked_for(here):
    with Server(content=three_periods().encode()) as server:
        results = fitted("data=ngsim", "data.path=got.csv", "data.download=true", f"data.url={server.url}")
    assert (here / "got.csv").is_file()
    assert results["data"]["file"] == "got.csv"


def one_period() -> str:
    return raw_text(ngsim_rows(traffic().filter(pl.col("scene") == "synthetic-0")))


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["data=ngsim"], "data=ngsim: which file is missing; give data.path=FILE."),
        (["data=highd"], "data=highd: which file is missing; give data.path=FILE."),
        (["data=ngsim", "data.path=gone.csv"], "gone.csv: no such file"),
        (["data=highd", "data.path=one.txt"], "one.txt: expected highD's XX_tracks.csv or a folder of recordings."),
        (["data=ngsim", "data.path=one.txt"], "recordings of one scene, one-1: one has to be fitted to and another"),
        (["data=ngsim", "data.path=cut.txt"], "cut.txt, line 200"),
        (["data=ngsim", "data.path=one.txt", "data.lanes=0"], "data.lanes=0: expected at least 1"),
        (["data.path=one.txt"], "one.txt"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(arguments, part, here, capsys):
    text = one_period()
    (here / "one.txt").write_text(text)
    (here / "cut.txt").write_text("\n".join(text.splitlines()[:200])[:-40])
    assert main([*arguments, *FEW]) == 2
    err = capsys.readouterr().err
    assert part in err
    assert err.count("\n") == 1
    assert sorted(path.name for path in here.iterdir()) == ["cut.txt", "one.txt"]
