"""Files of one lane."""

import numpy as np
import polars as pl
import pytest
from reference.recordings import following_file
from reference.refusals import user_error

from ganlane.data.one_lane import ONE_LANE_FILES, read_one_lane
from ganlane.realism.measures import measure

FRAME = np.arange(400)


def pairs_file(path):
    """A follower 25 m behind its leader, both at 9 m/s."""
    pair = {"pair": "2-1", "frame": FRAME, "length": 5.0}
    follower = pl.DataFrame(pair | {"role": "follower", "vehicle": 2, "x": 10.0 + 0.9 * FRAME})
    leader = pl.DataFrame(pair | {"role": "leader", "vehicle": 1, "x": 35.0 + 0.9 * FRAME})
    pl.concat((follower, leader)).write_csv(path)


def test_pairs_have_a_driven_follower_at_the_recorded_gap(tmp_path):
    # 40 s and 20 s, less the first 3, in pieces of 15.
    for name, write, pieces, gap, speed in (
        ("I-80, pairs", pairs_file, 2, 20.0, 9.0),
        ("I-80, following", following_file, 1, 10.0, 7.0),
    ):
        path = tmp_path / ONE_LANE_FILES[name]
        write(path)
        recordings = read_one_lane(name, path)
        assert len(recordings) == pieces
        assert {piece.lanes for piece in recordings} == {1}
        assert all(piece.driven.sum() == 1 for piece in recordings)
        quantiles = measure(recordings).quantiles
        assert quantiles["gap"]["0.5"] == pytest.approx(gap, abs=1e-6)
        assert quantiles["speed"]["0.5"] == pytest.approx(speed, abs=1e-6)
        assert recordings[0].speed[recordings[0].present] == pytest.approx(speed)


def test_a_lane_is_driven_as_a_whole_in_stretches_of_their_own(tmp_path):
    path = tmp_path / ONE_LANE_FILES["I-80, lane_1"]
    cars = []
    for car in range(12):
        # They enter one after the other.
        frame = np.arange(20 * car, 320)
        cars.append(pl.DataFrame({"vehicle": car, "frame": frame, "x": 1.8 * (frame - 20 * car)}))
    pl.concat(cars).write_csv(path)
    recordings = read_one_lane("I-80, lane_1", path)
    assert len({piece.unit for piece in recordings}) == len(recordings) == 2
    assert all(piece.driven.all() for piece in recordings)
    # 2 s apart at 18 m/s, cars of 4.5 m.
    assert measure(recordings).quantiles["gap"]["0.5"] == pytest.approx(31.5, abs=1e-6)


def test_a_file_without_a_whole_segment_is_refused(tmp_path):
    path = tmp_path / ONE_LANE_FILES["I-80, lane_1"]
    path.write_text("vehicle,frame,x\n1,2,3.0\n1,3,4.0\n")
    with user_error("nothing in it lasts 15 s"):
        read_one_lane("I-80, lane_1", path)


def test_a_car_that_measured_itself_follows_at_the_measured_gap_and_each_leader_is_another_car(
    tmp_path,
):
    # Nobody is seen for a second; then somebody else, nearer.
    gap = [30.0] * 200 + [None] * 10 + [20.0] * 190
    path = tmp_path / "instrumented.csv"
    pl.DataFrame({"drive": 1, "time_s": FRAME / 10, "v": 25.0, "gap": gap}).write_csv(path)
    first, second = read_one_lane("I-24", path)
    assert first.speed[first.present] == pytest.approx(25.0)
    # From second 3 to 18 one leader, from there to 33 both.
    assert (first.x.shape[1], second.x.shape[1]) == (2, 3)
    assert first.driven.tolist() == [True, False]
    assert first.x[:, 1] - first.x[:, 0] == pytest.approx(34.5)
    assert second.x[-1, 2] - second.x[-1, 0] == pytest.approx(24.5)


def test_an_echo_of_the_radar_is_no_leader(tmp_path):
    """A position at which somebody is seen once would be a car that stands."""
    gap = [30.0] * 400
    gap[100:103] = [60.0, 80.0, 100.0]
    path = tmp_path / "instrumented.csv"
    pl.DataFrame({"drive": 1, "time_s": FRAME / 10, "v": 25.0, "gap": gap}).write_csv(path)
    first, _ = read_one_lane("I-24", path)
    # The follower, and its leader before and after.
    assert first.x.shape[1] == 3
    seen = first.present[:, 1:].any(1)
    assert (~seen).sum() == 3
