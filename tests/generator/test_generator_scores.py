import numpy as np
import pytest

from ganlane.generator.scores import (
    direction_scores,
    displacement_errors,
    errors_of,
    open_loop_scores,
    parts_of,
    rmse_by_second,
    side_classifier_share,
)
from ganlane.generator.windows import Windows


def windows_of(lanes, lengths, future) -> Windows:
    count = len(lanes)
    positions = np.concatenate([np.zeros((count, 9, 2)), future], axis=1)
    zero, scene = np.zeros(count, dtype=np.int64), np.arange(count) % 2
    return Windows(positions, scene, zero, zero, zero, np.array(lanes), np.array(lengths, float), ("a", "b"))


def test_errors_by_hand():
    recorded = np.zeros((2, 2, 2))
    course = np.array([[[3.0, 4.0], [0.0, 1.0]], [[0.0, 0.0], [0.0, 3.0]]])
    errors = errors_of({"own": course, "constant_velocity": course * 2}, recorded)
    np.testing.assert_allclose(errors["own"], [[5.0, 1.0], [0.0, 3.0]])
    row = displacement_errors(errors)
    assert row["ade_m"] == {"own": 2.25, "constant_velocity": 4.5}
    assert row["fde_m"]["own"] == 2.0
    assert row["ade_change_percent"] == {"own": -50.0, "constant_velocity": 0.0}
    assert displacement_errors(errors, np.array([False, True]))["ade_m"]["own"] == 1.5


def test_root_mean_square_after_whole_seconds():
    errors = np.zeros((2, 25))
    errors[:, 9], errors[:, 19] = [3.0, 4.0], [6.0, 8.0]
    rmse = rmse_by_second({"own": errors})["own"]
    assert rmse.keys() == {"1 s", "2 s"}
    assert rmse["1 s"] == pytest.approx(np.sqrt(12.5))
    assert rmse["2 s"] == pytest.approx(np.sqrt(50.0))


def test_direction_counts_only_who_moves_sideways():
    recorded = np.zeros((4, 8, 2))
    recorded[:, -1, 1] = [0.2, -0.2, 0.05, -0.3]
    course = np.zeros((4, 8, 2))
    course[:, -1, 1] = [0.01, 0.4, -1.0, -0.1]
    scores = direction_scores({"own": course, "still": 0 * course}, recorded)
    assert scores["windows"] == 3
    assert scores["share_right"] == {"own": pytest.approx(2 / 3), "still": 0.0}


def test_parts_are_lanes_and_classes_with_enough_windows():
    windows = windows_of([1, 1, 1, 2, 2, 3], [4, 4, 4, 7, 7, 4], np.zeros((6, 8, 2)))
    parts = parts_of(windows, 2)
    assert {name: int(rows.sum()) for name, rows in parts.items()} == {"lane 1": 3, "lane 2": 2, "car": 4, "truck": 2}


def test_every_part_is_held_against_the_baseline():
    future = np.ones((4, 8, 2))
    windows = windows_of([1, 1, 2, 2], [4, 4, 4, 4], future)
    forecasts = {"constant_velocity": future + 1.0, "mean": future + np.array([0.1, 0.1, 3.0, 3.0])[:, None, None]}
    scores = open_loop_scores(windows, forecasts, np.array([0, 0, 1, 1]), least_part=1)
    change = {name: row["ade_change_percent"]["mean"] for name, row in scores["parts"].items()}
    assert change == {"lane 1": pytest.approx(-90.0), "lane 2": pytest.approx(200.0), "car": pytest.approx(55.0)}
    assert {name: row["windows"] for name, row in scores["parts"].items()} == {"lane 1": 2, "lane 2": 2, "car": 4}
    assert scores["folds"]["0"]["ade_change_percent"]["mean"] == pytest.approx(-90.0)
    assert scores["scenes"].keys() == {"a", "b"}
    assert scores["windows"] == 4


def test_over_the_whole_window_the_observed_move_counts_too():
    recorded = np.zeros((2, 8, 2))
    recorded[:, -1, 1] = [-0.05, 0.3]
    course = np.zeros((2, 8, 2))
    course[:, -1, 1] = [0.0, -0.1]
    scores = direction_scores({"own": course}, recorded, observed=np.array([0.4, 0.02]))
    assert scores == {"windows": 2, "share_right": {"own": 0.5}}
    assert direction_scores({"own": course}, recorded) == {"windows": 1, "share_right": {"own": 0.0}}


def test_the_side_classifier_finds_what_the_history_tells_and_no_more():
    random = np.random.default_rng(0)
    count = 600
    past, luck = random.normal(size=count), random.normal(size=count)
    fold = np.arange(count) % 2
    shares = []
    for source in (past, luck):
        future = np.zeros((count, 8, 2))
        future[:, -1, 1] = np.sign(source) * 0.3
        windows = windows_of([1] * count, [4] * count, future)
        windows.positions[:, :9, 1] = past[:, None] * np.linspace(-1, 0, 9)
        shares.append(side_classifier_share(windows, fold))
    assert shares[0] > 0.98
    assert 0.4 < shares[1] < 0.6


def test_nobody_moving_sideways_has_no_side():
    windows = windows_of([1, 2], [4, 4], np.zeros((2, 8, 2)))
    assert side_classifier_share(windows, np.array([0, 1])) is None
    assert direction_scores({"own": windows.future}, windows.future)["share_right"] == {"own": None}
