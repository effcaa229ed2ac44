"""Forecasts by both presets and IDM, and their scores."""

import numpy as np
import pytest
import torch
from reference.recordings import recorded_cars
from reference.small_networks import silenced, small_generator

from ganlane.generator import forecasts
from ganlane.generator.windows import cut_windows
from ganlane.settings.generator import EXTRA_INPUTS, CalibratedConfig


def test_errors_by_hand():
    recorded = np.zeros((2, 2, 2))
    course = np.array([[[3.0, 4.0], [0.0, 1.0]], [[0.0, 0.0], [0.0, 3.0]]])
    errors = forecasts.errors_of({"own": course, "constant_velocity": course * 2}, recorded)
    np.testing.assert_allclose(errors["own"], [[5.0, 1.0], [0.0, 3.0]])
    row = forecasts.displacement_errors(errors)
    assert row["ade_m"] == {"own": 2.25, "constant_velocity": 4.5}
    assert row["fde_m"]["own"] == 2.0
    assert row["ade_change_percent"] == {"own": -50.0, "constant_velocity": 0.0}
    assert forecasts.displacement_errors(errors, np.array([False, True]))["ade_m"]["own"] == 1.5


def test_root_mean_square_after_whole_seconds():
    errors = np.zeros((2, 25))
    errors[:, 9], errors[:, 19] = [3.0, 4.0], [6.0, 8.0]
    expected = {"1 s": pytest.approx(np.sqrt(12.5)), "2 s": pytest.approx(np.sqrt(50.0))}
    scores = forecasts.long_errors({"own": errors, "constant_velocity": 2.0 * errors})
    assert scores["rmse_m"]["own"] == expected
    assert scores["windows"] == 2
    assert scores["ratio_to_constant_velocity"] == {
        "own": pytest.approx(0.5),
        "constant_velocity": 1.0,
    }


STRIDE = 7


@pytest.fixture(scope="module")
def scenes():
    """Two scenes; in the first a vehicle leaves early and another comes late."""
    every = recorded_cars(scenes=2, vehicles=7, seconds=6.0)
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
    assert forecasts.by_kind(samples[:2], recorded).keys() == {"mean", "single"}


def test_without_noise_in_the_weights_all_samples_of_a_rollout_agree(scenes):
    generator = silenced(small_generator(EXTRA_INPUTS))
    driver = forecasts.calibrated_driver(generator, CalibratedConfig(), samples=3)
    mean, single, *_ = forecasts.driven_windows(driver, scenes, 8, STRIDE, 4)
    np.testing.assert_allclose(single, mean, atol=1e-5)
    # without a residual the anchor alone drives: along the road that is IDM with the driver's own
    # headway
    (idm,) = forecasts.driven_windows(forecasts.idm_driver, scenes, 8, STRIDE)
    np.testing.assert_allclose(mean[..., 0], idm[..., 0], atol=1e-3)


def test_steady_driving_is_foreseen_by_constant_velocity():
    course = forecasts.repeated(np.array([[2.0, 0.1]]), 3)
    np.testing.assert_allclose(course, [[[2.0, 0.1], [4.0, 0.2], [6.0, 0.3]]])


def test_the_energy_score_is_least_for_the_right_spread():
    torch.manual_seed(0)
    recorded = torch.randn(20000, 2)
    scores = {
        spread: forecasts.energy_score(
            spread * torch.randn(20000, 2), spread * torch.randn(20000, 2), recorded
        )
        .mean()
        .item()
        for spread in (0.01, 0.5, 1.0, 1.5, 2.5)
    }
    assert min(scores, key=scores.get) == 1.0
