"""Forecasts of recorded windows, and their scores.

Forecasters are both presets, IDM, and baselines without a network.
Every forecast is positions [W, T, 2] in m relative to the present, for the windows of
:func:`~ganlane.generator.windows.cut_windows` in the same order. Kinds of forecasts by a generator:
``mean`` (z = 0), ``single`` (one sample), ``best_of_20`` (by ADE). ADE is the mean error over the
predicted steps, FDE the error at the last of them, both in m.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import RidgeCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from ganlane.generator.checkpoint import Metrics
from ganlane.generator.closed_loop import (
    displacement_of,
    driven_positions,
    driver_params,
    moved_by,
    rollout,
)
from ganlane.generator.networks import Generator
from ganlane.generator.windows import (
    OBSERVED_POSITIONS,
    PREDICTED_STEPS,
    PRESENT,
    Groups,
    SceneTracks,
    Segments,
    Windows,
    cut_windows,
    segment_batches,
)
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.generator import CalibratedConfig
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.neighbours import perceive
from ganlane.sim.state import Vehicles

#: Samples of which the best counts.
SAMPLES = 20
#: Every ADE change is relative to this forecast: the last displacement repeated.
BASELINE = "constant_velocity"
#: Vehicles longer than this are trucks, m.
TRUCK_M = 6.0
#: A lateral move over the horizon has a direction if it is larger than this, m.
SIDEWAYS_M = 0.1
#: Keeps the gradient of a distance of 0 finite; 0.1 mm.
_SMALLEST_DISTANCE_M = 1e-4
#: Name of a forecast to positions [W, T, 2] in m relative to the present, or to errors [W, T] in m.
Forecasts = dict[str, np.ndarray]
#: Scores as plain data, for JSON and tables.
Row = dict[str, Any]
# What goes through a network in one pass; bounds the memory.
#: Groups of windows.
_GROUPS = 128
#: Segments times samples.
_ROLLOUTS = 160
#: Segments with three samples each.
_SEGMENTS = 16
#: Penalties from which the ridge regression chooses by leave-one-out validation.
_PENALTIES = tuple(10.0**power for power in range(-2, 6))


def distance(one: Tensor, other: Tensor) -> Tensor:
    """Euclidean distance [...] between positions [..., 2], with a finite gradient at distance 0."""
    apart = one - other
    return torch.sqrt((apart * apart).sum(-1) + _SMALLEST_DISTANCE_M * _SMALLEST_DISTANCE_M)


def scene_metrics(windows: Windows, forecasts: Forecasts) -> Metrics:
    """``{"all" or scene: {"ade_m/KIND", "fde_m/KIND", ..., "windows"}}`` of the forecasts, in m."""
    errors = errors_of(forecasts, windows.future)
    everywhere = np.ones(len(windows), dtype=bool)
    metrics: Metrics = {}
    for name, rows in {
        "all": everywhere,
        **windows.by_scene,
    }.items():
        # Flat names, as metadata and tables want them.
        row = displacement_errors(errors, rows)
        metrics[name] = {"windows": float(row["windows"])}
        for error in ("ade_m", "fde_m"):
            for kind in forecasts:
                metrics[name][f"{error}/{kind}"] = row[error][kind]
    return metrics


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


def parts_of(windows: Windows, least: int) -> dict[str, np.ndarray]:
    """Masks [W] of the windows by lane (1 the leftmost) and by class.

    Parts with fewer than ``least`` windows are left out.
    """
    lanes = windows.lane_from_left
    parts = {f"lane {lane}": lanes == lane for lane in np.unique(lanes)}
    parts["car"] = windows.length <= TRUCK_M
    parts["truck"] = windows.length > TRUCK_M
    return {name: rows for name, rows in parts.items() if rows.sum() >= least}


def direction_scores(
    forecasts: Forecasts,
    recorded: np.ndarray,
    observed: np.ndarray | float = 0.0,
) -> Row:
    """Among vehicles that move more than 0.1 m sideways: share predicted to the right side.

    ``observed`` are lateral moves [W] in m before the present, to be added to both.
    """
    # Vehicles that hardly move sideways have no side to predict.
    lateral = observed + recorded[:, -1, 1]
    moving = np.abs(lateral) > SIDEWAYS_M
    shares: dict[str, float | None] = {}
    for name, course in forecasts.items():
        # A product above 0: both moves are to the same side.
        right = ((observed + course[:, -1, 1]) * lateral > 0)[moving]
        shares[name] = float(right.mean()) if len(right) else None
    return {"windows": int(moving.sum()), "share_right": shares}


def side_classifier_share(windows: Windows, fold: np.ndarray) -> float | None:
    """Share of lateral moves after the present whose side a dedicated classifier predicts.

    None without moves. Gradient boosting on the observed motion, the lane and the length, fitted to
    the other folds' moving vehicles: a reference for :func:`direction_scores`, about as much as the
    history contains.
    """
    lateral = windows.future[:, -1, 1]
    moving = np.abs(lateral) > SIDEWAYS_M

    # The observed displacements, their changes along the road, how far the vehicle has moved
    # sideways since each of them; then the lane from both sides, and the length.
    past = windows.past
    # From the present backwards: entry k is the sum of the last k + 1 lateral displacements.
    moved = past[..., 1][:, ::-1].cumsum(axis=1)
    others = np.stack(
        [windows.lane, windows.lane_from_left, windows.length],
        axis=1,
    )
    differences = np.diff(past, axis=1)[..., 0]
    features = np.concatenate(
        [past.reshape(len(past), -1), differences, moved, others],
        axis=1,
    )
    features = features[moving]
    left = lateral[moving] > 0
    fold = fold[moving]

    hits = []
    for number in np.unique(fold):
        # Fitted to the other folds only; both sides must occur there.
        tested = fold == number
        if len(np.unique(left[~tested])) == 2:
            model = HistGradientBoostingClassifier(max_iter=150, max_leaf_nodes=15, random_state=0)
            model.fit(features[~tested], left[~tested])
            hits.append(model.predict(features[tested]) == left[tested])
    return float(np.concatenate(hits).mean()) if hits else None


def rmse_by_second(
    errors: Forecasts,
) -> dict[str, dict[str, float]]:
    """Root mean square error in m after each whole second (10 steps), of every forecast."""
    rmse: dict[str, dict[str, float]] = {}
    for name, values in errors.items():
        # Steps are 0.1 s apart, so index 9 is the first whole second.
        seconds = enumerate(values.T[9::10], start=1)
        rmse[name] = {f"{k} s": float(np.sqrt((error**2).mean())) for k, error in seconds}
    return rmse


def open_loop_scores(
    windows: Windows,
    forecasts: Forecasts,
    fold: np.ndarray,
    least_part: int = 100,
) -> Row:
    """All scores of the forecasts of ``windows``, each of which was held out in its ``fold`` [W].

    Parts (lanes, classes) of fewer than ``least_part`` windows are left out.
    """
    errors = errors_of(forecasts, windows.future)
    folds = {str(number): fold == number for number in range(int(fold.max()) + 1)}

    def by(masks: dict[str, np.ndarray]) -> dict[str, Row]:
        return {
            name: displacement_errors(errors, rows) for name, rows in masks.items() if rows.any()
        }

    direction = direction_scores(forecasts, windows.future)
    direction["share_right"]["side classifier"] = side_classifier_share(windows, fold)
    # The lateral move over the observed part, m.
    observed = windows.past[..., 1].sum(1)
    return {
        **displacement_errors(errors),
        "folds": by(folds),
        "scenes": by(windows.by_scene),
        "parts": by(parts_of(windows, least_part)),
        "direction": direction,
        "direction_whole_window": direction_scores(forecasts, windows.future, observed),
    }


def long_rollout_scores(windows: Windows, forecasts: Forecasts) -> Row:
    """RMSE after each second, and its ratio to constant velocity's at the end.

    The numbers of windows and tracks are added.
    """
    rmse = rmse_by_second(errors_of(forecasts, windows.future))
    last = f"{windows.future.shape[1] // 10} s"
    return {
        "windows": len(windows),
        "tracks": len(set(zip(windows.scene, windows.vehicle))),
        "rmse_m": rmse,
        "ratio_to_constant_velocity": {
            name: values[last] / rmse[BASELINE][last] for name, values in rmse.items()
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
    generator: Generator,
    windows: Windows,
    groups: Groups,
    seed: int = 0,
    samples: int = SAMPLES,
) -> Forecasts:
    """The paper's preset, open loop, on the windows in ``groups``."""
    random = torch.Generator().manual_seed(seed)
    positions = np.empty((1 + samples, *windows.future.shape))
    for rows in torch.arange(len(groups)).split(_GROUPS):
        chunk = groups.select(rows)
        past = chunk.displacements[..., : generator.sizes.observed, :]
        observation = generator.observe(past, chunk.position, chunk.mask)
        noise = torch.randn(
            1 + samples,
            *chunk.mask.shape,
            generator.sizes.noise,
            generator=random,
        )
        # The first sample is the mean prediction.
        noise[0] = 0.0
        predicted = generator(observation, noise).cumsum(dim=-2)
        # From groups back to the order of the windows.
        row = chunk.window[chunk.mask].numpy()
        positions[:, row] = predicted[:, chunk.mask].double().numpy()
    return by_kind(positions, windows.future)


def driven_windows(
    driver: Callable[[Segments], Tensor],
    scenes: list[SceneTracks],
    horizon: int,
    stride: int,
    samples: int = 1,
) -> np.ndarray:
    """Forecasts [K, W, H, 2] of all windows of 9 + ``horizon`` frames.

    These are of the vehicles recorded throughout a segment, whose vehicles ``driver`` drives all
    jointly: positions [K, B, H, V, 2] of K = ``samples``.
    """
    # Samples multiply the rows, so fewer segments go through in one pass.
    size = max(1, _ROLLOUTS // samples)
    forecasts = []
    for scene in scenes:
        for segments in segment_batches(scene, horizon, stride, size):
            present = segments.positions[:, PRESENT, None]
            positions = driver(segments.without_intentions()) - present
            # A window is a vehicle that is recorded in all frames.
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
    """The calibrated preset, rolled out through whole scenes.

    Target lanes and drivers are those of the present.
    """
    random = torch.Generator().manual_seed(0)

    def driver(segments: Segments) -> Tensor:
        shape = (
            1 + horizon,
            1 + samples,
            *segments.length.shape,
            generator.sizes.noise,
        )
        noise = torch.randn(shape, generator=random)
        noise[:, 0] = 0.0
        drivers = driver_params(segments, config.traits)
        return rollout(
            generator,
            segments,
            drivers,
            noise,
            config,
        )

    forecasts = driven_windows(
        driver,
        scenes,
        horizon,
        stride,
        1 + samples,
    )
    # The recording takes the same way, so that its windows come in the same order.
    recorded = driven_windows(
        lambda segments: segments.future[None],
        scenes,
        horizon,
        stride,
    )[0]
    return by_kind(forecasts, recorded)


@torch.no_grad()
def idm_forecasts(
    scenes: list[SceneTracks],
    horizon: int,
    stride: int,
) -> Forecasts:
    """IDM along the road in whole scenes, with constant lateral positions.

    ``idm``: all drivers with Table V's headway and a desired speed of 22 m/s. ``idm_own_headway``:
    with the headway at which each driver is in balance at present, the calibrated preset's anchor.
    """

    def driver(segments: Segments, own_headway: bool) -> Tensor:
        headway, desired = driver_params(segments, traits=own_headway)

        def move(vehicles: Vehicles, step: int) -> Vehicles:
            scene = perceive(vehicles, segments.road)
            acceleration = following_acceleration(scene, TABLE_V, headway)
            speed = displacement_of(vehicles)[..., 0] / PHYSICS_STEP_S
            velocity = speed + acceleration * PHYSICS_STEP_S
            return moved_by(vehicles, velocity, torch.zeros_like(velocity))

        return driven_positions(segments, desired, move)[None]

    return {
        name: driven_windows(
            partial(driver, own_headway=balanced),
            scenes,
            horizon,
            stride,
        )[0]
        for name, balanced in (
            ("idm", False),
            ("idm_own_headway", True),
        )
    }


def baseline_forecasts(
    windows: Windows,
    others: list[SceneTracks],
    stride: int,
) -> Forecasts:
    """Forecasts without a network.

    ``mean_velocity`` repeats the mean observed displacement, which recorded noise disturbs less
    than the last one. The ridge regression is fitted to windows of the scenes ``others``.
    """
    past = windows.past
    steps = windows.future.shape[1]
    fitted = cut_windows(others, stride, OBSERVED_POSITIONS + steps)
    return {
        BASELINE: repeated(past[:, -1], steps),
        "mean_velocity": repeated(past.mean(axis=1), steps),
        "constant_acceleration": constant_acceleration(past, steps),
        "ridge": ridge_forecast(fitted, past),
    }


def repeated(displacement: np.ndarray, steps: int) -> np.ndarray:
    """Positions [W, T, 2] in m after the present when ``displacement`` [W, 2] per 0.1 s repeats."""
    return displacement[:, None] * np.arange(1.0, steps + 1.0)[:, None]


def constant_acceleration(past: np.ndarray, steps: int) -> np.ndarray:
    """Positions [W, T, 2] in m when the displacement keeps changing by its mean observed change per
    step.
    """
    # Eight displacements have seven changes between them.
    change = ((past[:, -1] - past[:, 0]) / (past.shape[1] - 1))[:, None]
    ahead = np.arange(1.0, steps + 1.0)[:, None]
    # After n steps the change has been added 1 + 2 + ... + n times: n (n + 1) / 2.
    return repeated(past[:, -1], steps) + 0.5 * change * ahead * (ahead + 1.0)


def ridge_forecast(fitted: Windows, past: np.ndarray) -> np.ndarray:
    """Positions [W, T, 2] in m that follow the displacements ``past`` [W, 8, 2].

    Ridge regression from the last displacement and all observed differences to the error of
    constant velocity; it is fitted to the windows ``fitted``, as they are and mirrored.
    """

    def features(past: np.ndarray) -> np.ndarray:
        return np.concatenate([past[:, -1:], np.diff(past, axis=1)], axis=1).reshape(len(past), -1)

    # Left and right are alike: the fit must not learn the side that was recorded more often.
    mirrored = (1.0, -1.0)
    observed = np.concatenate([fitted.past, fitted.past * mirrored])
    future = np.concatenate([fitted.future, fitted.future * mirrored])
    steps = future.shape[1]
    # Fitted is what constant velocity misses, so the penalty pulls towards constant velocity.
    missing = future - repeated(observed[:, -1], steps)
    model = make_pipeline(StandardScaler(), RidgeCV(alphas=_PENALTIES))
    model.fit(features(observed), missing.reshape(len(missing), -1))
    return repeated(past[:, -1], steps) + model.predict(features(past)).reshape(len(past), steps, 2)


def energy_score(
    one: Tensor,
    other: Tensor,
    recorded: Tensor,
) -> Tensor:
    """Energy score [...] of two samples: mean error minus half their distance, in m.

    All are positions [..., 2]. A proper score: least in expectation when the samples are drawn from
    the distribution of the recordings (Gneiting and Raftery 2007).
    """
    mean_error = 0.5 * (distance(one, recorded) + distance(other, recorded))
    return mean_error - 0.5 * distance(one, other)


@torch.no_grad()
def rollout_errors(
    generator: Generator,
    scenes: list[SceneTracks],
    config: CalibratedConfig,
) -> Metrics:
    """Errors of the calibrated preset's rollouts through scenes, for all and for each scene.

    Target lanes and driver parameters are those of the present, so no information of the future is
    used. Unlike forecasts of windows, these count a vehicle for as long as it is recorded.

    Returns:
        ``{"all" or scene: {"ade_m/KIND" over 0.8 s, "fde_m/KIND" at 0.8 s, "end_m/KIND" at the last
        step, "relative_mean", "relative_energy", "end_s", "windows"}}`` with the kinds ``mean``,
        ``single``, ``constant_velocity`` and ``energy`` (the energy score of two samples).
    """
    random = torch.Generator().manual_seed(0)
    horizon = config.held_out_horizon
    parts: dict[str, list[tuple[dict[str, Tensor], Tensor]]] = {"all": []}
    for scene in scenes:
        for batch in segment_batches(scene, horizon, config.held_out_stride, _SEGMENTS):
            segments = batch.without_intentions()
            future = segments.future
            drivers = driver_params(segments, config.traits)
            # Three rollouts at once: the mean prediction, and two samples.
            shape = (
                1 + horizon,
                2,
                *segments.length.shape,
                generator.sizes.noise,
            )
            fresh = torch.randn(shape, generator=random)
            noise = torch.cat([torch.zeros_like(fresh[:, :1]), fresh], dim=1)
            mean, one, other = rollout(
                generator,
                segments,
                drivers,
                noise,
                config,
            )
            errors = {
                "mean": distance(mean, future),
                "single": distance(one, future),
                "energy": energy_score(one, other, future),
                BASELINE: distance(segments.constant_velocity, future),
            }
            for name in ("all", scene.name):
                parts.setdefault(name, []).append((errors, segments.scored))
    return {name: _step_means(errors, horizon) for name, errors in parts.items()}


def _step_means(parts: list[tuple[dict[str, Tensor], Tensor]], horizon: int) -> dict[str, float]:
    """Means over the vehicles that are still recorded at the step in question."""
    means = {
        kind: mean_by_step([(errors[kind], scored) for errors, scored in parts])
        for kind in parts[0][0]
    }
    # ADE and FDE are over 0.8 s at most, so that they compare with those of windows.
    short = min(PREDICTED_STEPS, horizon)
    windows = float(sum(scored[:, 0].sum() for _, scored in parts))
    metrics = {"end_s": 0.1 * horizon, "windows": max(1.0, windows)}
    for kind, errors in means.items():
        metrics[f"ade_m/{kind}"] = float(errors[:short].mean())
        metrics[f"fde_m/{kind}"] = float(errors[short - 1])
        metrics[f"end_m/{kind}"] = float(errors[-1])
    for kind in ("mean", "energy"):
        ratio = means[kind] / means[BASELINE].clamp_min(1e-6)
        metrics[f"relative_{kind}"] = float(ratio.mean())
    return metrics


def mean_by_step(parts: list[tuple[Tensor, Tensor]]) -> Tensor:
    # Sums and counts are pooled first, since batches differ in their number of vehicles.
    """Mean [H] of errors [B, H, V] where their mask [B, H, V] is true, over all parts."""
    count = torch.stack([scored.sum((0, 2)) for _, scored in parts]).sum(0).clamp_min(1)
    total = torch.stack([(errors * scored).sum((0, 2)) for errors, scored in parts]).sum(0)
    return total / count
