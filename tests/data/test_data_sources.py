"""Where recordings are, and synthetic recordings, in which nobody overlaps."""

from __future__ import annotations

import sys

import polars as pl
import pytest
from reference.refusals import user_error
from reference.synthetic import SyntheticTraffic, synthetic_scenes

from ganlane.data import byte_progress, default_scenes, scene_lane_counts, tracks_of_frame
from ganlane.data.lanes import find_lane_changes
from ganlane.data.schema import validate
from ganlane.data.sources import data_folder
from ganlane.data.statistics import leader_gaps


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_shows_bytes_on_a_terminal_and_nothing_of_short_work_elsewhere(
    terminal, capsys, monkeypatch
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with byte_progress("read") as show:
        show(2_000_000, 4_000_000)
    err = capsys.readouterr().err
    assert ("read:  50%" in err and "2.00M/4.00M" in err) if terminal else err == ""


def test_the_recordings_are_found_through_the_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    with user_error(r"set GANLANE_DATA to a folder that holds ngsim/us101_scenes\.csv"):
        default_scenes()
    # First nothing, then a file, then no folder.
    (tmp_path / "ngsim").mkdir()
    deep = tmp_path / "ngsim" / "us101_scenes.csv"
    deep.write_text("scene,vehicle")
    assert default_scenes() == deep
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path / "nowhere"))
    with user_error("no such folder"):
        data_folder()


def test_the_recordings_are_found_beside_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    module = sys.modules["ganlane.data.sources"]
    # As if the package were installed elsewhere.
    monkeypatch.setattr(
        module,
        "__file__",
        str(tmp_path / "site" / "ganlane" / "data" / "sources.py"),
    )
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    assert data_folder() is None
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert data_folder() == tmp_path / "shared" / "data"


def test_a_seed_makes_one_recording_and_another_seed_another():
    assert synthetic_scenes(seed=1).equals(synthetic_scenes(seed=1))
    assert not synthetic_scenes(seed=1).equals(synthetic_scenes(seed=2))
    # Scenes of one seed differ, too.
    one, other = synthetic_scenes(seed=1).partition_by("scene", include_key=False)
    assert not one.equals(other)


@pytest.mark.parametrize("lanes", [1, 2, 5])
def test_it_fits_the_schema_and_uses_every_lane(lanes):
    frame = synthetic_scenes(SyntheticTraffic(lanes=lanes))
    assert validate(frame, "made").equals(frame)
    assert set(scene_lane_counts(frame).values()) == {lanes}


@pytest.mark.parametrize("seed", range(5))
def test_nobody_comes_near_another_along_the_road(seed):
    # All put into one lane, the smallest gap is still that between slots less the sway of both.
    one_lane = synthetic_scenes(seed=seed).with_columns(lane=pl.lit(0, pl.Int64))
    assert leader_gaps(one_lane)["gap"].min() > 2.0


def test_the_share_of_changing_vehicles_is_found_by_the_detector():
    for changing, wander_m in (
        (40, 0.0),
        (0, SyntheticTraffic.wander_m),
    ):
        traffic = SyntheticTraffic(
            scenes=1,
            vehicles=40,
            changing_share=changing / 40,
            wander_m=wander_m,
        )
        tracks = tracks_of_frame(synthetic_scenes(traffic), {"synthetic-0": 3.5})
        assert len(find_lane_changes(tracks)) == changing
