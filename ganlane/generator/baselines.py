"""Forecasts that need no network: constant velocity, constant acceleration, ridge regression on the history."""

from __future__ import annotations

import numpy as np
from sklearn.linear_model import RidgeCV
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler

from ganlane.generator.windows import Windows

#: Penalties among which the ridge regression chooses by leaving one window out.
_PENALTIES = tuple(10.0**power for power in range(-2, 6))


def constant_velocity(past: np.ndarray, steps: int) -> np.ndarray:
    """Positions [W, T, 2] in m when the last of the displacements ``past`` [W, 8, 2] is repeated."""
    return past[:, -1:] * _ahead(steps)


def mean_velocity(past: np.ndarray, steps: int) -> np.ndarray:
    """The same with the mean of all observed displacements (0.8 s), which recorded jitter disturbs less."""
    return past.mean(axis=1, keepdims=True) * _ahead(steps)


def constant_acceleration(past: np.ndarray, steps: int) -> np.ndarray:
    """Positions [W, T, 2] in m when the displacement goes on to change as it did on average while observed."""
    change = ((past[:, -1] - past[:, 0]) / (past.shape[1] - 1))[:, None]
    ahead = _ahead(steps)
    return past[:, -1:] * ahead + 0.5 * change * ahead * (ahead + 1.0)


def _ahead(steps: int) -> np.ndarray:
    """Steps ahead [T, 1]."""
    return np.arange(1.0, steps + 1.0)[:, None]


class RidgeForecast:
    """Linear regression with a penalty, from the generator's own history to what constant velocity misses.

    Sees the last displacement and the differences of all observed ones; fitted to windows and their mirror images.

    Args:
        windows: to fit to.
    """

    def __init__(self, windows: Windows):
        past, future = windows.past, windows.future
        past = np.concatenate([past, past * (1.0, -1.0)])
        future = np.concatenate([future, future * (1.0, -1.0)])
        self.steps = future.shape[1]
        missed = (future - constant_velocity(past, self.steps)).reshape(len(past), -1)
        self.model: Pipeline = make_pipeline(StandardScaler(), RidgeCV(alphas=_PENALTIES))
        self.model.fit(self._features(past), missed)

    def __call__(self, past: np.ndarray) -> np.ndarray:
        """Positions [W, T, 2] in m that follow the displacements ``past`` [W, 8, 2]."""
        missed = self.model.predict(self._features(past)).reshape(len(past), self.steps, 2)
        return constant_velocity(past, self.steps) + missed

    @staticmethod
    def _features(past: np.ndarray) -> np.ndarray:
        return np.concatenate([past[:, -1:], np.diff(past, axis=1)], axis=1).reshape(len(past), -1)
