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
    squared = (apart * apart).sum(-1)
    return torch.sqrt(squared + _SMALLEST_DISTANCE_M * _SMALLEST_DISTANCE_M)


def errors_of(forecasts: Forecasts, recorded: np.ndarray) -> Forecasts:
    """Distances [W, T] in m of every forecast [W, T, 2] to the recording."""
    errors = {}
    for name, positions in forecasts.items():
        errors[name] = np.linalg.norm(positions - recorded, axis=-1)
    return errors


def displacement_errors(errors: Forecasts, rows: np.ndarray | None = None) -> Row:
    """ADE and FDE in m of every forecast, and the ADE's change to the baseline's in %.

    Args:
        errors: of the forecasts, :data:`BASELINE` among them, [W, T] in m.
        rows: an index or a mask of the windows that count; None: all.

    Returns:
        ``windows`` (how many), and by the forecasts' names ``ade_m``, ``fde_m`` and
        ``ade_change_percent``.
    """
    # The same windows for all kinds, so that their errors can be compared.
    if rows is not None:
        errors = {name: values[rows] for name, values in errors.items()}
    ade = {name: float(values.mean()) for name, values in errors.items()}
    fde = {name: float(values[:, -1].mean()) for name, values in errors.items()}

    # Relative to constant velocity, since recordings differ in how hard they are to predict.
    baseline = ade[BASELINE]
    change = {name: 100.0 * (value / baseline - 1.0) for name, value in ade.items()}
    return {
        "windows": len(errors[BASELINE]),
        "ade_m": ade,
        "fde_m": fde,
        "ade_change_percent": change,
    }


def long_errors(errors: Forecasts) -> Row:
    """RMSE in m of every forecast after each whole second, and over constant velocity's at the end.

    Args:
        errors: of the forecasts, :data:`BASELINE` among them, [W, T] in m; T is 10 or more.

    Returns:
        ``windows`` (how many), and by the forecasts' names ``rmse_m`` (by ``"1 s"``, ``"2 s"`` and
        so on) and ``ratio_to_constant_velocity``.
    """
    # Steps are 0.1 s apart, so index 9 is the first whole second.
    rmse = {}
    for name, values in errors.items():
        squared = values[:, 9::10] ** 2
        rmse[name] = np.sqrt(squared.mean(0))

    by_second: dict[str, dict[str, float]] = {}
    ratios = {}
    for name, values in rmse.items():
        by_second[name] = {}
        for second, value in enumerate(values, start=1):
            by_second[name][f"{second} s"] = float(value)
        ratios[name] = float(values[-1] / rmse[BASELINE][-1])
    return {
        "windows": len(errors[BASELINE]),
        "rmse_m": by_second,
        "ratio_to_constant_velocity": ratios,
    }


def by_kind(samples: np.ndarray, recorded: np.ndarray) -> Forecasts:
    """The kinds of forecasts of a generator: ``mean``, ``single`` and, of 20 samples or more,
    ``best_of_20`` (by ADE).

    Args:
        samples: forecasts [1 + K, W, T, 2] in m, of which the first has z = 0.
        recorded: what they forecast, [W, T, 2] in m.
    """
    kinds = dict(zip(("mean", "single"), samples))
    if len(samples) > SAMPLES:
        # The best one is chosen per window, by its mean over the steps: [K, W].
        drawn = samples[1:]
        ade = np.linalg.norm(drawn - recorded, axis=-1).mean(-1)
        best = ade.argmin(0)
        kinds[f"best_of_{SAMPLES}"] = drawn[best, np.arange(len(recorded))]
    return kinds


@torch.no_grad()
def paper_forecasts(
    generator: Generator,
    windows: Windows,
    groups: Groups,
    seed: int,
    samples: int,
) -> np.ndarray:
    """Forecasts [1 + K, W, T, 2] by the paper's preset, open loop; the first has z = 0.

    Args:
        generator: of the paper's preset.
        windows: W windows.
        groups: these windows in groups (:func:`~ganlane.generator.windows.group_windows`).
        seed: of the latent vectors.
        samples: K, the forecasts that are drawn.
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

        # Positions are the sums of displacements, [1 + K, B, G, T, 2].
        predicted = generator(observation, noise).cumsum(dim=-2)

        # From groups back to the order of the windows.
        row = chunk.window[chunk.mask].numpy()
        positions[:, row] = predicted[:, chunk.mask].double().numpy()
    return positions


@torch.no_grad()
def driven_windows(
    driver: Driver,
    scenes: list[Recording],
    horizon: int,
    stride: int,
    times: int = 1,
) -> np.ndarray:
    """Forecasts [K, W, H, 2] in m by a driver, of all windows of 9 + H frames.

    These are of the vehicles recorded throughout a segment.

    Args:
        driver: drives the segments.
        scenes: recordings.
        horizon: H, the steps that are forecast.
        stride: frames between the starts of two segments.
        times: K, how often the driver drives a segment.
    """
    # Each time multiplies the rows, so fewer segments go through in one pass.
    size = max(1, _ROLLOUTS // times)
    forecasts = []
    for scene in scenes:
        for segments in segment_batches(scene, horizon, stride, size):
            present = segments.positions[:, PRESENT, None]
            positions = driver(segments.without_intentions()) - present

            # A window is a vehicle that is recorded in all frames. [K, B, V, H, 2] -> [K, W, H, 2].
            complete = segments.present.all(dim=1)
            of_windows = positions.transpose(2, 3)[:, complete]
            forecasts.append(of_windows.double().numpy())
    return np.concatenate(forecasts, axis=1)


def calibrated_driver(generator: Generator, config: CalibratedConfig, samples: int) -> Driver:
    """The calibrated preset: its mean prediction, then so many samples.

    Headways and desired speeds are those that drivers show at the present.
    """
    random = torch.Generator().manual_seed(0)

    def driver(segments: Segments) -> Tensor:
        shape = noise_shape(generator, segments, 1 + samples)
        noise = torch.randn(shape, generator=random)
        noise[:, 0] = 0.0
        return rollout(generator, segments, driver_params(segments), noise, config)

    return driver


def idm_driver(segments: Segments) -> Tensor:
    """IDM along the road, once, with constant lateral positions: a :data:`Driver`.

    Every driver has the headway at which it is in balance at present: the calibrated preset's
    anchor.
    """
    headway, desired = driver_params(segments)
    parameters = with_headways(TABLE_V, headway)

    def move(vehicles: Vehicles, step: int) -> Vehicles:
        scene = perceive(vehicles, segments.road)
        acceleration = following_acceleration(scene, parameters)
        speed = displacement_of(vehicles)[..., 0] / PHYSICS_STEP_S
        velocity = speed + acceleration * PHYSICS_STEP_S
        return moved_by(vehicles, velocity, torch.zeros_like(velocity))

    return driven_positions(segments, desired, move)[None]


def repeated(displacement: np.ndarray, steps: int) -> np.ndarray:
    """Positions [W, T, 2] in m after the present when ``displacement`` [W, 2] per 0.1 s repeats."""
    return displacement[:, None] * np.arange(1.0, steps + 1.0)[:, None]


def energy_score(one: Tensor, other: Tensor, recorded: Tensor) -> Tensor:
    """Energy score [...] of two samples: mean error minus half their distance, in m.

    A proper score: least in expectation when the samples are drawn from the distribution of the
    recordings (Gneiting and Raftery 2007).

    Args:
        one: a sample's positions, [..., 2] in m.
        other: those of another sample of the same drivers.
        recorded: positions, [..., 2] in m.
    """
    mean_error = 0.5 * (distance(one, recorded) + distance(other, recorded))
    # Two samples that are alike gain nothing from this term: variety pays.
    return mean_error - 0.5 * distance(one, other)


@torch.no_grad()
def rollout_score(generator: Generator, scenes: list[Recording], config: CalibratedConfig) -> float:
    """Score of the calibrated preset's rollouts through scenes; 1 is constant velocity, 0 is best.

    The mean of the error for z = 0 and of the energy score of two samples, both over constant
    velocity's error at the same step. Target lanes and driver parameters are those of the present,
    so no information of the future is used. Unlike in forecasts of windows, a vehicle counts for as
    long as it is recorded.

    Args:
        generator: of the calibrated preset.
        scenes: recordings that it was not fitted to.
        config: horizon and stride of the segments, and how fast the noise changes.
    """
    random = torch.Generator().manual_seed(0)
    # Parts of mean_by_step, of each of the three errors.
    mean_errors = []
    energies = []
    baselines = []
    for scene in scenes:
        cuts = segment_batches(scene, config.held_out_horizon, config.held_out_stride, _SEGMENTS)
        for batch in cuts:
            segments = batch.without_intentions()
            future = segments.future
            scored = segments.scored

            # Three rollouts at once: the mean prediction, and two samples.
            fresh = torch.randn(noise_shape(generator, segments, 2), generator=random)
            noise = torch.cat([torch.zeros_like(fresh[:, :1]), fresh], dim=1)
            drivers = driver_params(segments)
            mean, one, other = rollout(generator, segments, drivers, noise, config)

            mean_errors.append((distance(mean, future), scored))
            energies.append((energy_score(one, other, future), scored))
            baselines.append((distance(segments.constant_velocity, future), scored))

    # Where everybody stands, constant velocity makes no error.
    baseline = mean_by_step(baselines).clamp_min(1e-6)
    of_mean = (mean_by_step(mean_errors) / baseline).mean()
    of_samples = (mean_by_step(energies) / baseline).mean()
    return 0.5 * (float(of_mean) + float(of_samples))


def mean_by_step(parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Mean [H] of errors [B, H, V] where their mask [B, H, V] is true, over all parts."""
    # Sums and counts are pooled first, since batches differ in their number of vehicles.
    counts = []
    totals = []
    for errors, scored in parts:
        counts.append(scored.sum((0, 2)))
        totals.append((errors * scored).sum((0, 2)))

    # A step at which nobody counts has an error of 0.
    count = torch.stack(counts).sum(0).clamp_min(1)
    return torch.stack(totals).sum(0) / count
