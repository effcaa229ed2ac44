"""Preparing recordings: what is written reads back the same, and scenes pooled say what they say together."""

from __future__ import annotations

import errno
from pathlib import Path

import polars as pl
import pytest
from reference.recordings import ngsim_rows, portal_csv, traffic, write_highd

from ganlane.commands.prepare import long_report, short_report
from ganlane.data import (
    PooledStatistics,
    Scene,
    driving_statistics,
    prepare_recordings,
    read_recordings,
    read_scenes,
    scene_lane_widths,
    synthetic_scenes,
    write_prepared,
    write_scene_csv,
)
from ganlane.data.prepare import whole_folder
from ganlane.data.scenes import cut_into_scenes
from ganlane.errors import UserError
from ganlane.files import write_bytes

TOO_LONG = "s" * 300


def pooled(frame: pl.DataFrame) -> PooledStatistics:
    statistics = PooledStatistics()
    widths = scene_lane_widths(frame)
    for (name,), rows in frame.group_by("scene", maintain_order=True):
        statistics.add(Scene(name, rows, widths[name]))
    return statistics


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_scenes_one_by_one_say_what_they_say_together(seed):
    frame = synthetic_scenes(seed=seed)
    together, apart = driving_statistics(frame), pooled(frame)
    assert apart.exposure.__dict__ == pytest.approx(together.exposure.__dict__)
    assert apart.lane_changes.count == together.lane_changes.count
    assert apart.lane_changes.per_vehicle_km == pytest.approx(together.lane_changes.per_vehicle_km)
    assert apart.lane_changes.srlc == pytest.approx(together.lane_changes.srlc)
    assert apart.lane_changes.duration == together.lane_changes.duration
    for name in ("speed", "acceleration_raw", "acceleration_smoothed", "headway"):
        one, other = apart.describe(name), getattr(together, name)
        assert (one.count, one.mean, one.sd) == pytest.approx((other.count, other.mean, other.sd)), name
        assert one.quantiles == pytest.approx(other.quantiles, abs=0.02), name


def test_what_is_written_reads_back_the_same(tmp_path):
    made = synthetic_scenes(seed=5)
    csv = tmp_path / "mine.csv"
    write_scene_csv(made, csv)
    prepared = prepare_recordings("scenes", csv, tmp_path / "out")
    assert prepared.files == ("synthetic-0.parquet", "synthetic-1.parquet")
    assert read_scenes(tmp_path / "out").equals(read_scenes(csv))
    assert read_scenes(tmp_path / "out" / prepared.files[1])["scene"].unique().to_list() == ["synthetic-1"]
    assert prepared.written == prepared.count.kept == made.height
    again = prepare_recordings("scenes", tmp_path / "out", tmp_path / "again")
    assert again.to_dict()["rows"] == prepared.to_dict()["rows"]


def test_long_recordings_are_cut_into_scenes_when_written_and_measured_whole(tmp_path):
    csv = tmp_path / "mine.csv"
    write_scene_csv(synthetic_scenes(seed=5), csv)
    whole = prepare_recordings("scenes", csv, tmp_path / "whole").statistics.lane_changes
    cut = prepare_recordings("scenes", csv, tmp_path / "cut", scene_s=4.0)
    assert cut.statistics.lane_changes == whole
    scenes = read_scenes(tmp_path / "cut")
    per_scene = scenes.group_by("scene", maintain_order=True).agg(pl.col("frame").n_unique())
    assert per_scene["scene"].to_list() == [f"synthetic-{k}-00{part}" for k in range(2) for part in range(3)]
    assert per_scene["frame"].to_list() == [40, 40, 20] * 2
    assert cut_into_scenes(scenes, 100.0)["scene"].n_unique() == 6


def test_reports_state_rows_rates_and_durations(tmp_path):
    path = tmp_path / "portal.csv"
    path.write_text(portal_csv(ngsim_rows(traffic().filter(pl.col("scene") == "synthetic-0"))))
    path.write_text(path.read_text() + path.read_text().splitlines()[5] + "\n")
    prepared = prepare_recordings("ngsim", path, tmp_path / "out")
    for report in (short_report(prepared), long_report(prepared, "portal.csv", "report.png")):
        assert "541 read, 540 kept, 540 written" in report
        assert "dropped: 1 (duplicate)" in report
        assert "lane changes: 0; 0.000 per vehicle and km of road (equation 9)" in report
    assert "| us-101-1 | 540 | 9 | 6 | 3 |" in long_report(prepared, "portal.csv", "report.png")


def test_the_output_folder_appears_only_when_everything_was_written(tmp_path):
    lines = portal_csv(ngsim_rows(traffic().filter(pl.col("scene") == "synthetic-0")), thousands=False).splitlines()
    (tmp_path / "bad.csv").write_text("\n".join([*lines, lines[-1].replace(",", ",x", 1)]))
    with pytest.raises(UserError, match="line 542"):
        prepare_recordings("ngsim", tmp_path / "bad.csv", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious").write_text("")
    with pytest.raises(UserError, match=r"out: there already; choose another folder with out=FOLDER"):
        prepare_recordings("ngsim", tmp_path / "bad.csv", tmp_path / "out")
    assert (tmp_path / "out" / "precious").exists()


def test_a_recording_of_parked_cars_is_refused(tmp_path):
    parked = synthetic_scenes().with_columns(speed=pl.lit(0.0), x=pl.col("x").first().over("scene", "vehicle"))
    write_prepared(parked, tmp_path / "parked.parquet")
    with pytest.raises(UserError, match="no scene in which anybody drives"):
        prepare_recordings("scenes", tmp_path / "parked.parquet", tmp_path / "out")


def test_names_that_differ_in_a_blank_alone_are_refused(tmp_path):
    scenes = synthetic_scenes().with_columns(
        pl.col("scene").replace({"synthetic-0": "my road", "synthetic-1": "my_road"})
    )
    write_prepared(scenes, tmp_path / "a.parquet")
    with pytest.raises(UserError, match=r"a second scene that my_road.parquet is the file of"):
        prepare_recordings("scenes", tmp_path / "a.parquet", tmp_path / "out")


def test_recordings_without_vehicles_on_the_lanes_are_refused(tmp_path):
    write_highd(tmp_path)
    tracks = tmp_path / "01_tracks.csv"
    pl.read_csv(tracks).with_columns(laneId=pl.lit(9)).write_csv(tracks)
    with pytest.raises(UserError, match="no vehicle on any of the lanes kept"):
        read_recordings("highd", tmp_path)


@pytest.mark.parametrize("absolute", [True, False])
def test_an_error_names_the_folder_to_be_and_other_files_as_they_are(absolute, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = (tmp_path if absolute else Path()) / "scenes"
    long = out.with_name(TOO_LONG[:250])  # the hidden one beside it has a longer name

    def raised(path, fill) -> OSError:
        with pytest.raises(OSError) as caught, whole_folder(path) as folder:  # noqa: PT011
            fill(folder)
        return caught.value

    def absent(name):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", name)

    refused = raised(out, lambda folder: write_bytes(folder / TOO_LONG, b""))
    assert (refused.errno, refused.filename) == (errno.ENAMETOOLONG, str(out / TOO_LONG))
    refused = raised(out, Path.mkdir)
    assert (refused.errno, refused.filename) == (errno.EEXIST, str(out))
    refused = raised(long, absent)
    assert (refused.errno, refused.filename) == (errno.ENAMETOOLONG, str(long))
    for name in ("scenes.csv", ".hidden/scenes.csv", None):
        assert raised(out, lambda folder, name=name: absent(name)).filename == name
    assert list(tmp_path.iterdir()) == []
