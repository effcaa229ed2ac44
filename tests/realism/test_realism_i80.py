"""The I-80 files."""

import polars as pl
import pytest
from reference.recordings import following_file
from reference.refusals import user_error

from ganlane.realism.i80 import I80_FILES, read_i80
from ganlane.realism.measures import measure_recordings


def lane_file(path):
    rows = [
        (car, frame, 20.0 + 1.8 * (frame - 20 * car), 0.0)
        for car in range(12)
        for frame in range(20 * car, 320)
    ]
    pl.DataFrame(
        rows,
        schema=["vehicle", "frame", "x", "x_raw"],
        orient="row",
    ).write_csv(path)


def pairs_file(path):
    rows = [
        (
            "2-1",
            role,
            number,
            float(frame),
            10.0 + start + 0.9 * frame,
            None,
            9.0,
            2,
            5.0,
            2.0,
        )
        for frame in range(400)
        for role, number, start in (
            ("follower", 2, 0.0),
            ("leader", 1, 25.0),
        )
    ]
    names = [
        "pair",
        "role",
        "vehicle",
        "frame",
        "x",
        "y_right",
        "v",
        "lane",
        "length",
        "width",
    ]
    pl.DataFrame(rows, schema=names, orient="row").write_csv(path)


def test_pairs_have_a_driven_follower_at_the_recorded_gap(
    tmp_path,
):
    for name, write, gap, speed in (
        ("pairs", pairs_file, 20.0, 9.0),
        ("following", following_file, 10.0, 7.0),
    ):
        write(tmp_path / I80_FILES[name])
        recordings = read_i80(name, tmp_path / I80_FILES[name])
        # 40 s and 20 s, less the first 3, in pieces of 15.
        assert len(recordings) == {"pairs": 2, "following": 1}[name]
        assert {piece.lanes for piece in recordings} == {1}
        assert all(piece.driven.sum() == 1 for piece in recordings)
        quantiles = measure_recordings(recordings).quantiles
        assert quantiles["gap"]["0.5"] == pytest.approx(gap, abs=1e-6)
        assert quantiles["speed"]["0.5"] == pytest.approx(speed, abs=1e-6)
        assert recordings[0].speed[recordings[0].present] == pytest.approx(speed)


def test_a_lane_is_driven_as_a_whole_in_stretches_of_their_own(
    tmp_path,
):
    lane_file(tmp_path / I80_FILES["lane_1"])
    recordings = read_i80("lane_1", tmp_path / I80_FILES["lane_1"])
    assert len({piece.unit for piece in recordings}) == len(recordings) == 2
    assert all(piece.driven.all() for piece in recordings)
    # 2 s apart at 18 m/s, cars of 4.5 m.
    assert measure_recordings(recordings).quantiles["gap"]["0.5"] == pytest.approx(31.5, abs=1e-6)


def test_damaged_files_are_named(tmp_path):
    path = tmp_path / I80_FILES["lane_1"]
    path.write_text("vehicle,frame,x\n1,2,three\n")
    with user_error("line 2, column x"):
        read_i80("lane_1", path)
    path.write_text("vehicle,frame,x\n1,2,3.0\n1,3,4.0\n")
    with user_error("nothing in it lasts 15 s"):
        read_i80("lane_1", path)
