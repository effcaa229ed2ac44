import numpy as np

from ganlane.data import SyntheticTraffic, synthetic_scenes
from ganlane.generator.forecasts import RidgeForecast, baseline_forecasts, constant_acceleration, repeated
from ganlane.generator.windows import Windows, scene_tracks

RANDOM = np.random.default_rng(0)


def windows_of(positions: np.ndarray) -> Windows:
    none = np.zeros(len(positions), dtype=np.int64)
    return Windows(positions, none, none, none, none, none, none.astype(float), ("scene",))


def course(start_mps: float, acceleration: float, frames: int = 17) -> np.ndarray:
    """Positions [1, frames, 2] of a vehicle whose displacement per 0.1 s changes by ``acceleration / 100`` m."""
    steps = start_mps * 0.1 + 0.01 * acceleration * np.arange(frames - 1)
    x = np.concatenate([[0.0], steps.cumsum()])
    return np.stack([x, np.zeros(frames)], axis=-1)[None]


def test_steady_driving_is_foreseen_by_all():
    windows = windows_of(course(20.0, 0.0))
    for positions in (
        repeated(windows.past[:, -1], 8),
        repeated(windows.past.mean(1), 8),
        constant_acceleration(windows.past, 8),
    ):
        np.testing.assert_allclose(positions, windows.future, atol=1e-9)
    np.testing.assert_allclose(windows.future[0, :, 0], 2.0 * np.arange(1, 9))


def test_steady_acceleration_is_foreseen_by_constant_acceleration_alone():
    windows = windows_of(course(10.0, 1.5))
    np.testing.assert_allclose(constant_acceleration(windows.past, 8), windows.future, atol=1e-9)
    # the displacement grows by 0.015 m a step, so after 8 steps 0.015 * (1 + 2 + ... + 8) m are missing
    missing = windows.future - repeated(windows.past[:, -1], 8)
    np.testing.assert_allclose(missing[0, -1], [0.015 * 36, 0.0], atol=1e-9)


def test_the_mean_velocity_looks_at_all_that_was_observed():
    steps = np.array([1.0] * 4 + [2.0] * 4 + [0.0] * 8)
    x = np.concatenate([[0.0], steps.cumsum()])
    windows = windows_of(np.stack([x, np.zeros(17)], axis=-1)[None].repeat(3, axis=0))
    scene = scene_tracks(synthetic_scenes(SyntheticTraffic(scenes=1, vehicles=3, seconds=4.0)))
    mean = baseline_forecasts(windows, scene, 3)["mean_velocity"]
    np.testing.assert_allclose(mean[0, :2], [[1.5, 0.0], [3.0, 0.0]])


def noisy_followers(count: int) -> np.ndarray:
    """Displacements that swing back: what constant velocity misses is linear in the last difference."""
    past = 1.0 + 0.1 * RANDOM.normal(size=(count, 8, 2))
    future = past[:, -1:] - 0.5 * (past[:, -1:] - past[:, -2:-1]) + np.zeros((count, 8, 2))
    steps = np.concatenate([past, future], axis=1)
    return np.concatenate([np.zeros((count, 1, 2)), steps.cumsum(1)], axis=1)


def test_ridge_regression_finds_a_linear_law_and_keeps_left_and_right_alike():
    ridge = RidgeForecast(windows_of(noisy_followers(400)))
    fresh = windows_of(noisy_followers(50))
    predicted = ridge(fresh.past)
    assert np.abs(predicted - fresh.future).mean() < 0.02 * np.abs(fresh.future).mean()
    np.testing.assert_allclose(ridge(fresh.past * (1, -1)), predicted * (1, -1), atol=1e-8)
