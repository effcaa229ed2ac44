"""``ganlane realism`` from end to end, with tiny budgets, in process."""

import polars as pl
import pytest
from PIL import Image
from reference.recordings import following_file
from reference.refusals import last_path, refusal, results_in
from reference.scene_csv import write_scene_csv
from reference.synthetic import synthetic_scenes

from ganlane.config.run import run_command
from ganlane.realism.measures import QUANTITIES
from ganlane.realism.sheets import card_text

pytestmark = pytest.mark.usefixtures("no_recordings")
QUICK = ["quick=true", "vehicle_km=0.5", "long_s=10", "long_vehicles=[4]"]


@pytest.fixture
def recordings(empty_folder):
    path = empty_folder / "scenes.csv"
    write_scene_csv(synthetic_scenes(scenes=3, vehicles=6, seconds=6.0), path)
    return path


def run(capsys, *arguments):
    """The results with their folder, stdout, stderr."""
    assert run_command("realism", [*QUICK, *arguments]) == 0
    out, err = capsys.readouterr()
    folder = last_path(out).parent
    return {**results_in(folder), "folder": folder}, out, err


def test_a_users_own_traffic_gets_a_card_of_every_quantity_and_one_of_i80_beside_the_scenes(
    recordings, capsys
):
    # Found beside the scenes.
    following_file(recordings.parent / "i80_following.csv")
    mine = ["traffic=idm", "traffic._target_=entry_own_parts.Cruise", f"data.path={recordings}"]
    more = ["scenes=all", "i80=true", "long_against=true", "data.held_out=[synthetic-1]"]
    results, out, _ = run(capsys, *mine, *more)
    assert results["traffic"] == "entry_own_parts.Cruise"
    assert len(results["scenes"]) == 3
    assert results["quantities"].keys() == QUANTITIES.keys()
    row = results["quantities"]["speed"]
    assert row["against"].keys() == {"idm_mobil"}
    assert results["quantities_held_out"]["speed"]["samples"] < row["samples"]
    assert results["i80"]["I-80, following"].keys() == {"speed", "acceleration", "time_headway"}
    assert results["off_road"] is not None
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
    held_out = ["traffic=idm", f"data.path={recordings}", "data.held_out=[synthetic-1]"]
    short = ["quick=false", "repeats=1", "i80=false", "vehicle_km=0", "resamples=100"]
    results, _, err = run(capsys, *held_out, *short, "against=[]")
    assert "idm: fitting desired speeds on 2 scenes" in err
    assert results["desired_above_mps"].keys() == {"idm"}
    assert results["scenes"] == ["synthetic-1"]
    assert results["long_runs"] == []
    assert results["overlaps_per_1000_vehicle_km"] is None


def test_without_recordings_the_shipped_histograms_are_used_and_it_is_said(capsys):
    results, _, err = run(capsys, "traffic=idm_mobil", "against=[]", "vehicle_km=0")
    assert (results["starts"], results["i80"]) == ("spawned", {})
    assert "no recordings here" in err
    speed = results["quantities"]["speed"]
    assert None not in (speed["ceiling"], speed["floor"])


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["data.path=gone.csv"], "gone.csv: no such file"),
        (["against=[idm_mobli]"], "did you mean 'idm_mobil'"),
        (["against=[random]"], "leave it out"),
        (["data=ngsim"], "ganlane prepare"),
        (["i80=true"], "i80=true"),
        (
            ["traffic=gan", "traffic.path=gone.tensors", "desired_above_mps=5", "scenes=all"],
            "gone.tensors: no such file",
        ),
    ],
)
def test_mistakes_are_told_in_a_sentence_and_leave_nothing(arguments, part, recordings, capsys):
    driven = ["traffic=idm", f"data.path={recordings}", "vehicle_km=0"]
    assert part in refusal(capsys, "realism", *QUICK, *driven, *arguments)


def test_one_scene_is_refused_with_what_to_do_and_driven_whole_when_asked(recordings, capsys):
    pl.read_csv(recordings).filter(pl.col("scene") == "synthetic-1").write_csv(recordings)
    driven = ["traffic=idm", f"data.path={recordings}"]
    sentence = refusal(capsys, "realism", *QUICK, *driven)
    for part in ("one scene, synthetic-1", "scenes=all", "scene_s=30"):
        assert part in sentence
    results, _, _ = run(capsys, *driven, "scenes=all", "against=[]", "vehicle_km=0")
    assert results["scenes"] == ["synthetic-1"]
