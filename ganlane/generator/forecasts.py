"""Forecasts of recorded windows, and their scores.

Forecasters are the Social-GAN's presets, IDM, and constant velocity.
Every forecast is positions [W, T, 2] in m relative to the present, for the windows of
:func:`~ganlane.generator.windows.cut_windows` in the same order. All but the paper's preset and
constant velocity are drivers (:data:`Driver`), which drive whole segments. Kinds of forecasts by a
generator (:func:`by_kind`): ``mean`` (z = 0), ``single`` (one sample), ``best_of_20`` (by ADE).
ADE is the mean error over the predicted steps, FDE the error at the last of them, both in m.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ganlane.data.dense import Recording
from ganlane.generator.closed_loop import (
    displacement_of,
    driven_positions,
    driver_params,
    moved_by,
    noise_shape,
    rollout,
)
from ganlane.generator.networks import Generator
from ganlane.generator.windows import (
    PRESENT,
    Groups,
    Segments,
    Windows,
    segment_batches,
)
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.generator import CalibratedConfig
from ganlane.sim.idm import TABLE_V, following_acceleration, with_headways
from ganlane.sim.neighbours import perceive
from ganlane.sim.state import Vehicles

#: Samples of which the best counts.
SAMPLES = 20
#: Every ADE change is relative to this forecast: the last displacement repeated.
BASELINE = "constant_velocity"
#: Keeps the gradient of a distance of 0 finite; 0.1 mm.
_SMALLEST_DISTANCE_M = 1e-4
#: Name of a forecast to positions [W, T, 2] in m relative to the present, or to errors [W, T] in m.
Forecasts = dict[str, np.ndarray]
#: Drives all vehicles of B segments jointly: K times their positions [K, B, H, V, 2] in m.
Driver = Callable[[Segments], Tensor]
#: Scores as plain data, for JSON and tables.
Row = dict[str, Any]
# What goes through a network in one pass; bounds the memory.
#: Groups of windows.
_GROUPS = 128
#: Segments times samples.
_ROLLOUTS = 160
#: Segments with three samples each.
_SEGMENTS = 16


def distance(one: Tensor, other: Tensor) -> Tensor:
    """Euclidean distance [...] between positions [..., 2], with a finite gradient at distance 0."""
    apart = one - other
    return torch.sqrt((apart * apart).sum(-1) + _SMALLEST_DISTANCE_M * _SMALLEST_DISTANCE_M)


def errors_of(forecasts: Forecasts, recorded: np.ndarray) -> Forecasts:
    """Distances [W, T] in m of every forecast [W, T, 2] to the recording."""
    return {
        name: np.linalg.norm(positions - recorded, axis=-1) for name, positions in forecasts.items()
    }


def displacement_errors(errors: Forecasts, rows: np.ndarray | None = None) -> Row:
    """ADE and FDE in m of every forecast over the chosen windows.

    The ADE's change to the baseline's is added, in %.
    """
    # The same windows for all kinds, so that their errors can be compared.
    if rows is not None:
        errors = {name: values[rows] for name, values in errors.items()}
    ade = {name: float(values.mean()) for name, values in errors.items()}
    fde = {name: float(values[:, -1].mean()) for name, values in errors.items()}
    # Relative to constant velocity, since recordings differ in how hard they are to predict.
    change = {name: 100.0 * (value / ade[BASELINE] - 1.0) for name, value in ade.items()}
    return {
        "windows": len(errors[BASELINE]),
        "ade_m": ade,
        "fde_m": fde,
        "ade_change_percent": change,
    }


def long_errors(errors: Forecasts) -> Row:
    """RMSE in m after each whole second of every forecast; at the end, over constant velocity's."""
    # Steps are 0.1 s apart, so index 9 is the first whole second.
    rmse = {name: np.sqrt((values[:, 9::10] ** 2).mean(0)) for name, values in errors.items()}
    return {
        "windows": len(errors[BASELINE]),
        "rmse_m": {
            name: {f"{second} s": float(value) for second, value in enumerate(values, start=1)}
            for name, values in rmse.items()
        },
        "ratio_to_constant_velocity": {
            name: float(values[-1] / rmse[BASELINE][-1]) for name, values in rmse.items()
        },
    }


def by_kind(samples: np.ndarray, recorded: np.ndarray) -> Forecasts:
    """The kinds of forecasts in samples [1 + K, W, T, 2], of which the first has z = 0.

    ``mean``, ``single`` and, of 20 samples or more, ``best_of_20`` (by ADE).
    """
    kinds = dict(zip(("mean", "single"), samples))
    if len(samples) > SAMPLES:
        # The best one is chosen per window, by its mean over the steps.
        errors = np.linalg.norm(samples[1:] - recorded, axis=-1).mean(-1)
        kinds[f"best_of_{SAMPLES}"] = samples[1:][errors.argmin(0), np.arange(len(recorded))]
    return kinds


@torch.no_grad()
def paper_forecasts(
    generator: Generator, windows: Windows, groups: Groups, seed: int, samples: int
) -> np.ndarray:
    """Forecasts [1 + K, W, T, 2] by the paper's preset, open loop, on the windows in ``groups``.

    The first has z = 0, the K = ``samples`` others are drawn.
    """
    random = torch.Generator().manual_seed(seed)
    positions = np.empty((1 + samples, *windows.future.shape))
    for rows in torch.arange(len(groups)).split(_GROUPS):
        chunk = groups.select(rows)
        past = chunk.displacements[..., : generator.sizes.observed, :]
        observation = generator.observe(past, chunk.position, chunk.mask)
        shape = (1 + samples, *chunk.mask.shape, generator.sizes.noise)
        noise = torch.randn(shape, generator=random)
        # The first sample is the mean prediction.
        noise[0] = 0.0
        predicted = generator(observation, noise).cumsum(dim=-2)
        # From groups back to the order of the windows.
        row = chunk.window[chunk.mask].numpy()
        positions[:, row] = predicted[:, chunk.mask].double().numpy()
    return positions


@torch.no_grad()
def driven_windows(
    driver: Driver, scenes: list[Recording], horizon: int, stride: int, times: int = 1
) -> np.ndarray:
    """Forecasts [K, W, H, 2] by a ``driver`` of K = ``times`` of all windows of 9 + H frames.

    These are of the vehicles recorded throughout a segment; H is the ``horizon``.
    """
    # Each time multiplies the rows, so fewer segments go through in one pass.
    size = max(1, _ROLLOUTS // times)
    forecasts = []
    for scene in scenes:
        for segments in segment_batches(scene, horizon, stride, size):
            present = segments.positions[:, PRESENT, None]
            positions = driver(segments.without_intentions()) - present
            # A window is a vehicle that is recorded in all frames.
            complete = segments.present.all(dim=1)
            forecasts.append(positions.transpose(2, 3)[:, complete].double().numpy())
    return np.concatenate(forecasts, axis=1)


def calibrated_driver(generator: Generator, config: CalibratedConfig, samples: int) -> Driver:
    """The calibrated preset: its mean prediction, then so many samples.

    Drivers are those of the present.
    """
    random = torch.Generator().manual_seed(0)

    def driver(segments: Segments) -> Tensor:
        noise = torch.randn(noise_shape(generator, segments, 1 + samples), generator=random)
        noise[:, 0] = 0.0
        return rollout(generator, segments, driver_params(segments), noise, config)

    return driver


def idm_driver(segments: Segments) -> Tensor:
    """IDM along the road, once, with constant lateral positions: a :data:`Driver`.

    Every driver has the headway at which it is in balance at present: the calibrated preset's
    anchor.
    """
    headway, desired = driver_params(segments)

    def move(vehicles: Vehicles, step: int) -> Vehicles:
        scene = perceive(vehicles, segments.road)
        acceleration = following_acceleration(scene, with_headways(TABLE_V, headway))
        speed = displacement_of(vehicles)[..., 0] / PHYSICS_STEP_S
        velocity = speed + acceleration * PHYSICS_STEP_S
        return moved_by(vehicles, velocity, torch.zeros_like(velocity))

    return driven_positions(segments, desired, move)[None]


def repeated(displacement: np.ndarray, steps: int) -> np.ndarray:
    """Positions [W, T, 2] in m after the present when ``displacement`` [W, 2] per 0.1 s repeats."""
    return displacement[:, None] * np.arange(1.0, steps + 1.0)[:, None]


def energy_score(one: Tensor, other: Tensor, recorded: Tensor) -> Tensor:
    """Energy score [...] of two samples: mean error minus half their distance, in m.

    All are positions [..., 2]. A proper score: least in expectation when the samples are drawn from
    the distribution of the recordings (Gneiting and Raftery 2007).
    """
    mean_error = 0.5 * (distance(one, recorded) + distance(other, recorded))
    return mean_error - 0.5 * distance(one, other)


@torch.no_grad()
def rollout_score(generator: Generator, scenes: list[Recording], config: CalibratedConfig) -> float:
    """Score of the calibrated preset's rollouts through scenes; 1 is constant velocity, 0 is best.

    The mean of the error for z = 0 and of the energy score of two samples, both over constant
    velocity's error at the same step. Target lanes and driver parameters are those of the present,
    so no information of the future is used. Unlike in forecasts of windows, a vehicle counts for as
    long as it is recorded.
    """
    random = torch.Generator().manual_seed(0)
    horizon = config.held_out_horizon
    parts: list[tuple[tuple[Tensor, ...], Tensor]] = []
    for scene in scenes:
        for batch in segment_batches(scene, horizon, config.held_out_stride, _SEGMENTS):
            segments = batch.without_intentions()
            future = segments.future
            # Three rollouts at once: the mean prediction, and two samples.
            fresh = torch.randn(noise_shape(generator, segments, 2), generator=random)
            noise = torch.cat([torch.zeros_like(fresh[:, :1]), fresh], dim=1)
            mean, one, other = rollout(generator, segments, driver_params(segments), noise, config)
            errors = (
                distance(mean, future),
                energy_score(one, other, future),
                distance(segments.constant_velocity, future),
            )
            parts.append((errors, segments.scored))
    mean_error, energy, baseline = (
        mean_by_step([(errors[kind], scored) for errors, scored in parts]) for kind in range(3)
    )
    least = baseline.clamp_min(1e-6)
    return 0.5 * (float((mean_error / least).mean()) + float((energy / least).mean()))


def mean_by_step(parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Mean [H] of errors [B, H, V] where their mask [B, H, V] is true, over all parts."""
    # Sums and counts are pooled first, since batches differ in their number of vehicles.
    count = torch.stack([scored.sum((0, 2)) for _, scored in parts]).sum(0).clamp_min(1)
    total = torch.stack([(errors * scored).sum((0, 2)) for errors, scored in parts]).sum(0)
    return total / count
