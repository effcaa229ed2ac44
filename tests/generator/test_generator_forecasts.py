"""Forecasts by both presets, IDM and baselines, and their scores."""

import numpy as np
import pytest
import torch
from reference.small_networks import silenced, small_generator
from reference.synthetic import SyntheticTraffic, synthetic_scenes

from ganlane.generator import forecasts
from ganlane.generator.windows import (
    Windows,
    cut_windows,
    group_windows,
    scene_tracks,
)
from ganlane.settings.generator import EXTRA_INPUTS, CalibratedConfig


def windows_of(positions: np.ndarray, lanes=0, lengths=4) -> Windows:
    """Windows at ``positions`` [W, T, 2] or, where they stand still before, with that future.

    Scenes a, b in turn.
    """
    if positions.shape[1] == 8:
        positions = np.concatenate([np.zeros((len(positions), 9, 2)), positions], axis=1)
    count = len(positions)
    zero = np.zeros(count, dtype=np.int64)
    return Windows(
        positions=positions,
        scene=np.array(["a", "b"])[np.arange(count) % 2],
        start=zero,
        vehicle=zero,
        lane=zero,
        lane_from_left=zero + lanes,
        length=zero + np.array(lengths, float),
    )


def test_errors_by_hand():
    recorded = np.zeros((2, 2, 2))
    course = np.array([[[3.0, 4.0], [0.0, 1.0]], [[0.0, 0.0], [0.0, 3.0]]])
    errors = forecasts.errors_of({"own": course, "constant_velocity": course * 2}, recorded)
    np.testing.assert_allclose(errors["own"], [[5.0, 1.0], [0.0, 3.0]])
    row = forecasts.displacement_errors(errors)
    assert row["ade_m"] == {"own": 2.25, "constant_velocity": 4.5}
    assert row["fde_m"]["own"] == 2.0
    assert row["ade_change_percent"] == {
        "own": -50.0,
        "constant_velocity": 0.0,
    }
    assert forecasts.displacement_errors(errors, np.array([False, True]))["ade_m"]["own"] == 1.5


def test_root_mean_square_after_whole_seconds():
    errors = np.zeros((2, 25))
    errors[:, 9], errors[:, 19] = [3.0, 4.0], [6.0, 8.0]
    expected = {
        "1 s": pytest.approx(np.sqrt(12.5)),
        "2 s": pytest.approx(np.sqrt(50.0)),
    }
    assert forecasts.rmse_by_second({"own": errors}) == {"own": expected}


def sideways(*moves_m: float) -> np.ndarray:
    """Positions [W, 8, 2] with these lateral positions at the end."""
    positions = np.zeros((len(moves_m), 8, 2))
    positions[:, -1, 1] = moves_m
    return positions


def test_direction_counts_only_who_moves_sideways():
    recorded = sideways(0.2, -0.2, 0.05, -0.3)
    course = sideways(0.01, 0.4, -1.0, -0.1)
    scores = forecasts.direction_scores({"own": course, "still": 0 * course}, recorded)
    assert scores["windows"] == 3
    assert scores["share_right"] == {
        "own": pytest.approx(2 / 3),
        "still": 0.0,
    }


def test_parts_are_lanes_and_classes_with_enough_windows():
    windows = windows_of(np.zeros((6, 8, 2)), [1, 1, 1, 2, 2, 3], [4, 4, 4, 7, 7, 4])
    parts = forecasts.parts_of(windows, 2)
    windows_by_part = {name: int(rows.sum()) for name, rows in parts.items()}
    assert windows_by_part == {
        "lane 1": 3,
        "lane 2": 2,
        "car": 4,
        "truck": 2,
    }


def test_every_part_is_held_against_the_baseline():
    future = np.ones((4, 8, 2))
    windows = windows_of(future, [1, 1, 2, 2])
    predicted = {
        "constant_velocity": future + 1.0,
        "mean": future + np.array([0.1, 0.1, 3.0, 3.0])[:, None, None],
    }
    scores = forecasts.open_loop_scores(windows, predicted, np.array([0, 0, 1, 1]), least_part=1)
    change = {name: row["ade_change_percent"]["mean"] for name, row in scores["parts"].items()}
    assert change == {
        "lane 1": pytest.approx(-90.0),
        "lane 2": pytest.approx(200.0),
        "car": pytest.approx(55.0),
    }
    assert scores["folds"]["0"]["ade_change_percent"]["mean"] == pytest.approx(-90.0)
    assert scores["scenes"].keys() == {"a", "b"}
    assert scores["windows"] == 4


def test_over_the_whole_window_the_observed_move_counts_too():
    recorded = sideways(-0.05, 0.3)
    course = sideways(0.0, -0.1)
    scores = forecasts.direction_scores({"own": course}, recorded, observed=np.array([0.4, 0.02]))
    assert scores == {"windows": 2, "share_right": {"own": 0.5}}
    assert forecasts.direction_scores({"own": course}, recorded) == {
        "windows": 1,
        "share_right": {"own": 0.0},
    }


def test_the_side_classifier_finds_what_the_history_tells_and_no_more():
    random = np.random.default_rng(0)
    count = 600
    past = random.normal(size=count)
    luck = random.normal(size=count)
    fold = np.arange(count) % 2
    shares = []
    for source in (past, luck):
        windows = windows_of(sideways(*(np.sign(source) * 0.3)), 1)
        windows.positions[:, :9, 1] = past[:, None] * np.linspace(-1, 0, 9)
        shares.append(forecasts.side_classifier_share(windows, fold))
    assert shares[0] > 0.98
    assert 0.4 < shares[1] < 0.6


def test_nobody_moving_sideways_has_no_side():
    windows = windows_of(np.zeros((2, 8, 2)), [1, 2])
    assert forecasts.side_classifier_share(windows, np.array([0, 1])) is None
    assert forecasts.direction_scores({"own": windows.future}, windows.future)["share_right"] == {
        "own": None
    }


STRIDE = 7


@pytest.fixture(scope="module")
def scenes():
    """Two scenes; in the first a vehicle leaves early and another comes late."""
    every = scene_tracks(synthetic_scenes(SyntheticTraffic(scenes=2, vehicles=7, seconds=6.0)))
    every[0].present[25:, 1] = False
    every[0].present[:12, 3] = False
    return every


@pytest.mark.parametrize("horizon", [8, 20])
def test_driven_windows_are_the_cut_windows_in_the_same_order(scenes, horizon):
    windows = cut_windows(scenes, STRIDE, 9 + horizon)
    recorded = forecasts.driven_windows(
        lambda segments: segments.future[None], scenes, horizon, STRIDE
    )[0]
    np.testing.assert_allclose(recorded, windows.future, atol=1e-4)


def test_the_best_of_the_samples_is_the_nearest_on_average():
    recorded = np.zeros((2, 3, 2))
    samples = np.zeros((22, 2, 3, 2))
    samples[1:, ..., 0] = 5.0
    samples[4, 0], samples[9, 1] = 1.0, 2.0
    kinds = forecasts.by_kind(samples, recorded)
    np.testing.assert_array_equal(kinds["best_of_20"], np.stack([samples[4, 0], samples[9, 1]]))
    assert forecasts.by_kind(samples[:1], recorded).keys() == {"mean"}
    assert forecasts.by_kind(samples[:2], recorded).keys() == {
        "mean",
        "single",
    }


def test_forecasts_of_the_papers_preset_score_alike_in_a_fit_and_over_folds(
    scenes,
):
    generator = small_generator(0)
    windows = cut_windows(scenes, STRIDE)
    predicted = forecasts.paper_forecasts(generator, windows, group_windows(windows, 4))
    predicted["constant_velocity"] = forecasts.repeated(windows.past[:, -1], 8)
    row = forecasts.displacement_errors(forecasts.errors_of(predicted, windows.future))
    metrics = forecasts.scene_metrics(windows, predicted)
    for kind in predicted:
        assert metrics["all"][f"ade_m/{kind}"] == row["ade_m"][kind]
        assert metrics["all"][f"fde_m/{kind}"] == row["fde_m"][kind]
    assert metrics.keys() == {"all", "synthetic-0", "synthetic-1"}
    assert (
        sum(metrics[scene.name]["windows"] for scene in scenes)
        == metrics["all"]["windows"]
        == len(windows)
    )
    assert row["ade_m"]["best_of_20"] < row["ade_m"]["mean"] < 1.5 * row["ade_m"]["single"]


def test_without_noise_in_the_weights_all_samples_of_a_rollout_agree(
    scenes,
):
    generator = silenced(small_generator(EXTRA_INPUTS))
    driven = forecasts.calibrated_forecasts(
        generator, scenes, 8, STRIDE, CalibratedConfig(), samples=3
    )
    np.testing.assert_allclose(driven["single"], driven["mean"], atol=1e-5)
    # without a residual the anchor alone drives: along the road that is IDM with the driver's own
    # headway
    idm = forecasts.idm_forecasts(scenes, 8, STRIDE)["idm_own_headway"]
    np.testing.assert_allclose(driven["mean"][..., 0], idm[..., 0], atol=1e-3)


def test_idm_keeps_the_lateral_position(scenes):
    for course in forecasts.idm_forecasts(scenes, 8, STRIDE).values():
        np.testing.assert_allclose(course[..., 1], 0.0, atol=1e-5)


RANDOM = np.random.default_rng(0)


def course(start_mps: float, acceleration: float, frames: int = 17) -> np.ndarray:
    """Positions [1, frames, 2] of a vehicle whose displacement per 0.1 s changes by
    ``acceleration / 100`` m.
    """
    steps = start_mps * 0.1 + 0.01 * acceleration * np.arange(frames - 1)
    x = np.concatenate([[0.0], steps.cumsum()])
    return np.stack([x, np.zeros(frames)], axis=-1)[None]


def test_steady_driving_is_foreseen_by_all():
    windows = windows_of(course(20.0, 0.0))
    past = windows.past
    for positions in (
        forecasts.repeated(past[:, -1], 8),
        forecasts.repeated(past.mean(1), 8),
        forecasts.constant_acceleration(past, 8),
    ):
        np.testing.assert_allclose(positions, windows.future, atol=1e-9)
    np.testing.assert_allclose(windows.future[0, :, 0], 2.0 * np.arange(1, 9))


def test_steady_acceleration_is_foreseen_by_constant_acceleration_alone():
    windows = windows_of(course(10.0, 1.5))
    np.testing.assert_allclose(
        forecasts.constant_acceleration(windows.past, 8),
        windows.future,
        atol=1e-9,
    )
    # the displacement grows by 0.015 m a step, so after 8 steps 0.015 * (1 + 2 + ... + 8) m are
    # missing
    missing = windows.future - forecasts.repeated(windows.past[:, -1], 8)
    np.testing.assert_allclose(missing[0, -1], [0.015 * 36, 0.0], atol=1e-9)


def test_the_mean_velocity_looks_at_all_that_was_observed():
    steps = np.array([1.0] * 4 + [2.0] * 4 + [0.0] * 8)
    x = np.concatenate([[0.0], steps.cumsum()])
    windows = windows_of(np.stack([x, np.zeros(17)], axis=-1)[None].repeat(3, axis=0))
    scene = scene_tracks(synthetic_scenes(SyntheticTraffic(scenes=1, vehicles=3, seconds=4.0)))
    mean = forecasts.baseline_forecasts(windows, scene, 3)["mean_velocity"]
    np.testing.assert_allclose(mean[0, :2], [[1.5, 0.0], [3.0, 0.0]])


def noisy_followers(count: int) -> np.ndarray:
    """Displacements that swing back.

    What constant velocity misses is linear in the last difference.
    """
    past = 1.0 + 0.1 * RANDOM.normal(size=(count, 8, 2))
    future = past[:, -1:] - 0.5 * (past[:, -1:] - past[:, -2:-1]) + np.zeros((count, 8, 2))
    steps = np.concatenate([past, future], axis=1)
    return np.concatenate([np.zeros((count, 1, 2)), steps.cumsum(1)], axis=1)


def test_ridge_regression_finds_a_linear_law_and_keeps_left_and_right_alike():
    fitted = windows_of(noisy_followers(400))
    fresh = windows_of(noisy_followers(50))
    predicted = forecasts.ridge_forecast(fitted, fresh.past)
    assert np.abs(predicted - fresh.future).mean() < 0.02 * np.abs(fresh.future).mean()
    np.testing.assert_allclose(
        forecasts.ridge_forecast(fitted, fresh.past * (1, -1)),
        predicted * (1, -1),
        atol=1e-8,
    )


def test_metrics_of_rollouts_name_every_scene_and_count_its_vehicles(
    scenes,
):
    config = CalibratedConfig(held_out_horizon=9, held_out_stride=20)
    metrics = forecasts.rollout_errors(small_generator(EXTRA_INPUTS), scenes, config)
    assert set(metrics) == {"all", "synthetic-0", "synthetic-1"}
    assert (
        metrics["all"]["windows"]
        == metrics["synthetic-0"]["windows"] + metrics["synthetic-1"]["windows"]
    )
    assert metrics["all"]["end_s"] == pytest.approx(0.9)
    assert metrics["all"]["fde_m/mean"] > metrics["all"]["ade_m/mean"]


def test_the_energy_score_is_least_for_the_right_spread():
    torch.manual_seed(0)
    recorded = torch.randn(20000, 2)
    scores = {
        spread: forecasts.energy_score(
            spread * torch.randn(20000, 2),
            spread * torch.randn(20000, 2),
            recorded,
        )
        .mean()
        .item()
        for spread in (0.01, 0.5, 1.0, 1.5, 2.5)
    }
    assert min(scores, key=scores.get) == 1.0
