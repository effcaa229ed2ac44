"""A fit and what comes of it: forecasts of the held-out scenes beside all baselines, kept so that it is done once."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ganlane.files import atomic_path
from ganlane.generator.baselines import RidgeForecast, constant_acceleration, constant_velocity, mean_velocity
from ganlane.generator.cache import content_hash, save_arrays
from ganlane.generator.calibrated import CalibratedConfig, CalibratedTask
from ganlane.generator.fit import fit_task
from ganlane.generator.fitting import PaperConfig, PaperTask
from ganlane.generator.folds import Split
from ganlane.generator.forecasts import Forecasts, calibrated_forecasts, idm_forecasts, paper_forecasts
from ganlane.generator.loop import FitLoop, OnProgress
from ganlane.generator.networks import Generator
from ganlane.generator.scores import errors_of, rmse_by_second
from ganlane.generator.stretches import scene_sources
from ganlane.generator.tracks import SceneTracks
from ganlane.generator.traits import common_traits, typical_traits
from ganlane.generator.windows import OBSERVED_POSITIONS, Windows, cut_windows, join_windows

#: Frames between the starts of two reported windows, for every preset: all are scored on the same windows.
STRIDE = 3
#: Steps of the long rollouts (5 s), and frames between their starts.
LONG_STEPS, LONG_STRIDE = 50, 5


@dataclass(frozen=True)
class Reported:
    """Windows of held-out scenes, and everybody's forecasts of them."""

    windows: Windows
    forecasts: Forecasts


@dataclass(frozen=True)
class Fitted:
    """What a fit foretold of the scenes held out: ``near`` as far as the preset predicts, ``far`` for 5 s.

    Only the calibrated preset is rolled out for 5 s, and only where somebody was recorded for so long. ``generator``
    has the weights that did best on the validation scenes, those after ``updates`` updates; the fit took ``seconds``.
    """

    near: Reported
    far: Reported | None
    generator: Generator
    updates: int
    seconds: float


def fit_and_report(
    preset: str,
    config: PaperConfig | CalibratedConfig,
    split: Split,
    widths: dict[str, float],
    folder: Path,
    on_progress: OnProgress | None = None,
) -> Fitted:
    """Fit a preset to ``split`` and forecast its held-out scenes.

    State and forecasts are kept in ``folder`` under a hash of recordings and settings, and gone on from.
    """
    task = fit_task(preset, split, widths, config)
    path = folder / f"{preset}_{fit_key(preset, config, split)}.pt"
    loop = FitLoop(task, config.loop, path)
    loop.run(on_progress)
    near, far = _kept(path, task, split, widths, config.sizes.predicted, STRIDE), None
    if isinstance(config, CalibratedConfig) and _long_enough(split.held_out):
        far = _kept(path, task, split, widths, LONG_STEPS, LONG_STRIDE)
    return Fitted(near, far, task.generator.eval().requires_grad_(False), loop.best_update, loop.seconds)


def fit_key(preset: str, config: PaperConfig | CalibratedConfig, split: Split) -> str:
    """Hash of what a fit follows from: settings, and the recordings by what they are for."""
    settings = {"preset": preset, "config": json.loads(json.dumps(asdict(config))), **split.names}
    scenes = (*split.fitted, *split.validation, *split.held_out)
    return content_hash(settings, *(part for scene in scenes for part in (scene.positions, scene.lane)))[:12]


def _long_enough(scenes: list[SceneTracks]) -> bool:
    return any((scene.present.sum(0) >= OBSERVED_POSITIONS + LONG_STEPS).any() for scene in scenes)


def _kept(
    path: Path, task: PaperTask | CalibratedTask, split: Split, widths: dict[str, float], steps: int, stride: int
) -> Reported:
    """:func:`report`, kept beside the fit's state."""
    path = path.with_name(f"{path.stem}_{steps}.npz")
    if path.exists():
        with np.load(path, allow_pickle=False) as kept:
            return Reported(cut_windows(split.held_out, stride, OBSERVED_POSITIONS + steps), dict(kept))
    reported = report(task, split, widths, steps, stride)
    courses = {name: course.astype(np.float32) for name, course in reported.forecasts.items()}
    with atomic_path(path) as part, part.open("wb") as file:
        save_arrays(file, courses)
    return Reported(reported.windows, courses)


def report(
    task: PaperTask | CalibratedTask, split: Split, widths: dict[str, float], steps: int, stride: int
) -> Reported:
    """Forecasts of the held-out scenes' windows ``steps`` ahead by a fitted task and by all baselines.

    The paper's preset forecasts as far as it was fitted to. The best of 20 is taken of short forecasts only.
    """
    config = task.config
    windows = cut_windows(split.held_out, stride, OBSERVED_POSITIONS + steps)
    sources = scene_sources(split.held_out, widths)
    if isinstance(config, PaperConfig):
        own = paper_forecasts(task.generator, windows, config.group_size, config.seed)
    else:
        samples = 1 if steps == LONG_STEPS else 20
        traits = typical_traits if config.traits else common_traits
        period = config.noise_period_s
        own = calibrated_forecasts(task.generator, sources, steps, stride, samples, period, 0, config.anchor, traits)
    plain = baseline_forecasts(windows, split.fitted + split.validation, stride)
    return Reported(windows, own | plain | idm_forecasts(sources, steps, stride))


def baseline_forecasts(windows: Windows, others: list[SceneTracks], stride: int) -> Forecasts:
    """Forecasts without a network; the ridge regression is fitted to windows of the ``others``."""
    past, steps = windows.past, windows.future.shape[1]
    ridge = RidgeForecast(cut_windows(others, stride, OBSERVED_POSITIONS + steps))
    return {
        "constant_velocity": constant_velocity(past, steps),
        "mean_velocity": mean_velocity(past, steps),
        "constant_acceleration": constant_acceleration(past, steps),
        "ridge": ridge(past),
    }


def pooled(parts: list[Reported]) -> tuple[Windows, Forecasts, np.ndarray]:
    """All folds' windows and forecasts, and the fold [W] of each window."""
    forecasts = {name: np.concatenate([part.forecasts[name] for part in parts]) for name in parts[0].forecasts}
    fold = np.concatenate([np.full(len(part.windows), number) for number, part in enumerate(parts)])
    return join_windows([part.windows for part in parts]), forecasts, fold


def rollout_scores(windows: Windows, forecasts: Forecasts) -> dict[str, Any]:
    """RMSE after 1 to 5 s, windows and tracks behind it, and the ratio to constant velocity after 5 s."""
    rmse = rmse_by_second(errors_of(forecasts, windows.future))
    last = f"{LONG_STEPS // 10} s"
    ratio = {name: values[last] / rmse["constant_velocity"][last] for name, values in rmse.items()}
    tracks = len(np.unique(np.stack([windows.scene, windows.vehicle]), axis=1).T)
    return {"windows": len(windows), "tracks": tracks, "rmse_m": rmse, "ratio_to_constant_velocity": ratio}
