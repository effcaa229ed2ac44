"""``ganlane realism`` from end to end, with tiny budgets, in process."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import polars as pl
import pytest
from PIL import Image
from reference.recordings import following_file
from reference.scene_csv import write_scene_csv
from reference.synthetic import SyntheticTraffic, synthetic_scenes

from ganlane.config.run import run_command
from ganlane.realism.measures import QUANTITIES
from ganlane.realism.sheets import card_text

main = partial(run_command, "realism")

QUICK = ["quick=true", "vehicle_km=0.5", "long_s=10", "long_vehicles=[4]"]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    # So that recordings of this machine have no effect.
    monkeypatch.setenv("GANLANE_DATA", str(nothing))


@pytest.fixture
def recordings(tmp_path):
    path = tmp_path / "recordings" / "scenes.csv"
    path.parent.mkdir()
    write_scene_csv(synthetic_scenes(SyntheticTraffic(scenes=4, vehicles=8, seconds=7.0)), path)
    return path


def run(capsys, *arguments):
    """Exit status, results.json (None without), stdout, stderr."""
    status = main([*QUICK, *arguments])
    out, err = capsys.readouterr()
    last = (out.splitlines() or [""])[-1]
    path = Path(last.removeprefix("results: ")) if last.startswith("results: ") else None
    results = None
    if path is not None:
        results = {**json.loads(path.read_text()), "folder": path.parent}
    return status, results, out, err


def test_a_users_own_traffic_gets_a_card_of_every_quantity_and_one_of_i80_beside_the_scenes(
    recordings, capsys
):
    # Found beside the scenes.
    following_file(recordings.parent / "i80_following.csv")
    mine = ["traffic=idm", "traffic._target_=entry_own_parts.Cruise", f"data.path={recordings}"]
    more = ["scenes=all", "i80=true", "long_against=true", "data.held_out=[synthetic-1]"]
    status, results, out, _ = run(capsys, *mine, *more)
    assert status == 0
    assert results["traffic"] == "entry_own_parts.Cruise"
    assert len(results["scenes"]) == 4
    assert results["quantities"].keys() == QUANTITIES.keys()
    # A row holds distance, interval, scale and rivals.
    row = results["quantities"]["speed"]
    assert 0.0 <= row["distance_ci"][0] <= row["distance"] <= 1.0
    assert None not in (row["ceiling"], row["floor"])
    assert row["against"].keys() == {"idm_mobil"}
    assert row["against"]["idm_mobil"]["verdict"] in ("closer", "farther", "undecided")
    assert results["quantities_held_out"]["speed"]["samples"] < row["samples"]
    assert results["i80"]["I-80, following"].keys() == {"speed", "acceleration", "time_headway"}
    for key in ("lane_changes_per_vehicle_km", "overlaps_per_1000_vehicle_km_ci", "off_road"):
        assert results[key] is not None
    assert results["machine"]
    assert results["long_runs"][0]["vehicle_km"] >= 0.5
    assert results["long_runs_against"].keys() == {"idm_mobil"}
    parts = ("changes per vehicle-km", "held-out scenes alone", "idm_mobil, long runs")
    assert all(part in out for part in (*parts, "I-80, following"))
    # The tables can be made again from the file.
    assert "\n\n".join(card_text(results)) in out
    for name in ("distributions.png", "distances.png"):
        assert Image.open(results["folder"] / name).width > 400


@pytest.mark.slow
def test_desired_speeds_are_fitted_on_the_scenes_that_are_not_held_out(recordings, capsys):
    arguments = [
        "quick=false",
        "repeats=1",
        "i80=false",
        "vehicle_km=0",
        "resamples=100",
        "against=[]",
    ]
    held_out = "data.held_out=[synthetic-1]"
    _, results, _, err = run(capsys, "traffic=idm", f"data.path={recordings}", held_out, *arguments)
    assert "idm: fitting desired speeds on 3 scenes" in err
    assert results["desired_above_mps"].keys() == {"idm"}
    assert results["scenes"] == ["synthetic-1"]
    assert results["long_runs"] == []
    assert results["overlaps_per_1000_vehicle_km"] is None


def test_without_recordings_the_shipped_histograms_are_used_and_it_is_said(capsys):
    status, results, _, err = run(capsys, "traffic=idm_mobil", "against=[]")
    assert status == 0
    assert (results["starts"], results["i80"]) == ("spawned", {})
    assert "no recordings here" in err
    speed = results["quantities"]["speed"]
    assert None not in (speed["ceiling"], speed["floor"])


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["data.path=gone.csv"], "gone.csv: no such file"),
        (["data.held_out=[moon]"], "moon"),
        (["against=[idm_mobli]"], "did you mean 'idm_mobil'"),
        (["against=[random]"], "leave it out"),
        (["traffic=replay"], "recordings themselves"),
        (["data=ngsim"], "ganlane prepare"),
        (["i80=true"], "i80=true"),
        (["scenes=some"], "held_out, all"),
        (["device=cuda"], "device=cuda"),
        (["traffic.path=gone.safetensors", "traffic=gan"], "gone.safetensors"),
    ],
)
def test_mistakes_are_told_in_a_sentence_and_leave_nothing(
    arguments, part, recordings, capsys, tmp_path
):
    # Nothing may be left behind, not even a run folder.
    before = sorted(path.name for path in tmp_path.iterdir())
    status, _, _, err = run(
        capsys, "traffic=idm", f"data.path={recordings}", "vehicle_km=0", *arguments
    )
    assert status == 2
    assert part in err
    assert "Traceback" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_one_scene_is_refused_with_what_to_do_and_driven_whole_when_asked(recordings, capsys):
    pl.read_csv(recordings).filter(pl.col("scene") == "synthetic-1").write_csv(recordings)
    status, _, _, err = run(capsys, "traffic=idm", f"data.path={recordings}")
    assert status == 2
    for part in ("one scene, synthetic-1", "scenes=all", "scene_s=30"):
        assert part in err
    alone = ["scenes=all", "against=[]", "vehicle_km=0"]
    assert run(capsys, "traffic=idm", f"data.path={recordings}", *alone)[0] == 0
