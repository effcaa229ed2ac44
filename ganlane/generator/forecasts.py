"""Forecasts of recorded windows in one form: by both presets, by IDM, and by baselines without a network.

Every function returns positions [W, T, 2] in m relative to the present, for the windows of
:func:`ganlane.generator.windows.cut_windows` in the same order.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from sklearn.linear_model import RidgeCV
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from ganlane.generator.closed_loop import displacement_of, moved_by
from ganlane.generator.networks import Generator
from ganlane.generator.rollout import (
    DriverParams,
    common_driver_params,
    driven_positions,
    evaluation_params,
    fit_anchor,
    rollout,
    typical_driver_params,
)
from ganlane.generator.scores import BASELINE, SAMPLES, Forecasts
from ganlane.generator.segments import (
    OBSERVED_POSITIONS,
    PRESENT,
    SceneTracks,
    Segments,
    constant_velocity,
    segment_batches,
)
from ganlane.generator.windows import Groups, Windows, cut_windows
from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.generator import CalibratedConfig
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.state import Vehicles

#: Groups, and segments times samples, in one pass; bounds the memory.
_GROUPS, _ROLLOUTS = 128, 160
#: Penalties from which the ridge regression chooses by leave-one-out validation.
_PENALTIES = tuple(10.0**power for power in range(-2, 6))


def by_kind(samples: np.ndarray, recorded: np.ndarray) -> Forecasts:
    """``mean`` (z = 0), ``single`` and ``best_of_20`` (by ADE) of samples [1 + K, W, T, 2], the first with z = 0."""
    if len(samples) < 2:
        return {"mean": samples[0]}
    kinds = {"mean": samples[0], "single": samples[1]}
    if len(samples) > SAMPLES:
        errors = np.linalg.norm(samples[1:] - recorded, axis=-1).mean(-1)
        kinds[f"best_of_{SAMPLES}"] = samples[1:][errors.argmin(0), np.arange(len(recorded))]
    return kinds


@torch.no_grad()
def paper_forecasts(
    generator: Generator, windows: Windows, groups: Groups, seed: int = 0, samples: int = SAMPLES
) -> Forecasts:
    """The paper's preset, open loop, on the windows in ``groups``."""
    random = torch.Generator().manual_seed(seed)
    positions = np.empty((1 + samples, *windows.future.shape))
    for rows in torch.arange(len(groups)).split(_GROUPS):
        chunk = groups.select(rows)
        past = chunk.displacements[..., : generator.sizes.observed, :]
        noise = torch.randn(1 + samples, *chunk.mask.shape, generator.sizes.noise, generator=random)
        noise[0] = 0.0
        predicted = generator(generator.observe(past, chunk.position, chunk.mask), noise).cumsum(dim=-2)
        positions[:, chunk.window[chunk.mask].numpy()] = predicted[:, chunk.mask].double().numpy()
    return by_kind(positions, windows.future)


def driven_windows(
    driver: Callable[[Segments], Tensor], scenes: list[SceneTracks], horizon: int, stride: int, samples: int = 1
) -> np.ndarray:
    """Forecasts [K, W, H, 2] of all windows of 9 + ``horizon`` frames.

    ``driver`` drives all vehicles of a batch of segments jointly: positions [K, B, H, V, 2] of K = ``samples``
    samples. Of every segment the vehicles are kept that were recorded throughout: these are the windows.
    """
    forecasts = []
    for scene in scenes:
        for segments in segment_batches(scene, horizon, stride, max(1, _ROLLOUTS // samples)):
            positions = driver(segments.without_intentions()) - segments.positions[:, PRESENT, None]
            complete = segments.present.all(dim=1)
            forecasts.append(positions.transpose(2, 3)[:, complete].double().numpy())
    return np.concatenate(forecasts, axis=1)


@torch.no_grad()
def calibrated_forecasts(
    generator: Generator,
    scenes: list[SceneTracks],
    horizon: int,
    stride: int,
    config: CalibratedConfig,
    samples: int = SAMPLES,
) -> Forecasts:
    """The calibrated preset, rolled out through whole scenes with the target lanes and drivers of the present."""
    random = torch.Generator().manual_seed(0)

    def driver(segments: Segments) -> Tensor:
        headway, desired = evaluation_params(config)(segments)
        noise = torch.randn(1 + horizon, 1 + samples, *headway.shape, generator.sizes.noise, generator=random)
        noise[:, 0] = 0.0
        return rollout(generator, segments, headway, desired, noise, config.noise_period_s, fit_anchor(config))

    forecasts = driven_windows(driver, scenes, horizon, stride, 1 + samples)
    recorded = driven_windows(lambda segments: segments.future[None], scenes, horizon, stride)[0]
    return by_kind(forecasts, recorded)


@torch.no_grad()
def idm_forecasts(scenes: list[SceneTracks], horizon: int, stride: int) -> Forecasts:
    """IDM along the road in whole scenes, with constant lateral positions.

    ``idm``: all drivers with Table V's headway and a desired speed of 22 m/s. ``idm_own_headway``: with the headway
    at which each driver is in balance at present, the calibrated preset's anchor.
    """

    def driver(segments: Segments, driver_params: DriverParams) -> Tensor:
        headway, desired = driver_params(segments)

        def move(vehicles: Vehicles, step: int) -> Vehicles:
            acceleration = following_acceleration(perceive(vehicles, segments.road), TABLE_V, headway)
            velocity = displacement_of(vehicles)[..., 0] / PHYSICS_STEP_S + acceleration * PHYSICS_STEP_S
            return moved_by(vehicles, velocity, torch.zeros_like(velocity))

        return driven_positions(segments, desired, move)[None]

    kinds = {"idm": common_driver_params, "idm_own_headway": typical_driver_params}
    return {
        name: driven_windows(partial(driver, driver_params=params), scenes, horizon, stride)[0]
        for name, params in kinds.items()
    }


def baseline_forecasts(windows: Windows, others: list[SceneTracks], stride: int) -> Forecasts:
    """Forecasts without a network; the ridge regression is fitted to windows of the scenes ``others``.

    ``mean_velocity`` repeats the mean observed displacement, which recorded noise disturbs less than the last one.
    """
    past, steps = windows.past, windows.future.shape[1]
    return {
        BASELINE: repeated(past[:, -1], steps),
        "mean_velocity": repeated(past.mean(axis=1), steps),
        "constant_acceleration": constant_acceleration(past, steps),
        "ridge": RidgeForecast(cut_windows(others, stride, OBSERVED_POSITIONS + steps))(past),
    }


def repeated(displacement: np.ndarray, steps: int) -> np.ndarray:
    """:func:`constant_velocity` for arrays: positions [W, T, 2] when ``displacement`` [W, 2] is repeated."""
    return constant_velocity(torch.from_numpy(displacement), steps).numpy()


def constant_acceleration(past: np.ndarray, steps: int) -> np.ndarray:
    """Positions [W, T, 2] in m when the displacement keeps changing by its mean observed change per step."""
    change = ((past[:, -1] - past[:, 0]) / (past.shape[1] - 1))[:, None]
    ahead = np.arange(1.0, steps + 1.0)[:, None]
    return repeated(past[:, -1], steps) + 0.5 * change * ahead * (ahead + 1.0)


class RidgeForecast:
    """Ridge regression from the last displacement and all observed differences to the error of constant velocity.

    Args:
        windows: to fit to, as they are and mirrored.
    """

    def __init__(self, windows: Windows):
        past, future = windows.past, windows.future
        past = np.concatenate([past, past * (1.0, -1.0)])
        future = np.concatenate([future, future * (1.0, -1.0)])
        self.steps = future.shape[1]
        error = (future - repeated(past[:, -1], self.steps)).reshape(len(past), -1)
        self.model: Pipeline = make_pipeline(StandardScaler(), RidgeCV(alphas=_PENALTIES))
        self.model.fit(self._features(past), error)

    def __call__(self, past: np.ndarray) -> np.ndarray:
        """Positions [W, T, 2] in m that follow the displacements ``past`` [W, 8, 2]."""
        error = self.model.predict(self._features(past)).reshape(len(past), self.steps, 2)
        return repeated(past[:, -1], self.steps) + error

    @staticmethod
    def _features(past: np.ndarray) -> np.ndarray:
        return np.concatenate([past[:, -1:], np.diff(past, axis=1)], axis=1).reshape(len(past), -1)
