"""Fits of a preset, scored on the scenes that they have not used: one split, k folds by scene,
ablations.

State and forecasts of folds and ablations are kept in a folder under a hash of recordings and
settings, so that an interrupted run resumes and nothing is fitted twice.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ganlane.data import TRACK, driving_statistics
from ganlane.errors import UserError
from ganlane.generator.checkpoint import (
    FitResult,
    Metrics,
    Preset,
    content_hash,
    load_arrays,
    save_arrays,
)
from ganlane.generator.forecasts import (
    BASELINE,
    SAMPLES,
    Forecasts,
    baseline_forecasts,
    calibrated_forecasts,
    displacement_errors,
    errors_of,
    idm_forecasts,
    long_rollout_scores,
    open_loop_scores,
    paper_forecasts,
)
from ganlane.generator.tasks import CalibratedTask, Config, FitLoop, OnProgress, PaperTask, Task
from ganlane.generator.windows import (
    OBSERVED_POSITIONS,
    SceneTracks,
    Windows,
    count_windows,
    cut_windows,
    group_windows,
    join_windows,
    scene_tracks,
)
from ganlane.settings.generator import CalibratedConfig, PaperConfig

#: Scenes that are held out by default.
HELD_OUT = ("us101-b", "us101-e", "us101-h", "us101-i")
#: Least share of the remaining windows that the validation scenes hold.
VALIDATION_SHARE = 1 / 12
#: Frames between the starts of two scored windows, the same for both presets.
STRIDE = 3
#: Steps of the long rollouts (5 s), and frames between their starts.
LONG_STEPS, LONG_STRIDE = 50, 5
#: Called with the name of the next fit.
OnFit = Callable[[str], None]
_CONFIGS: dict[str, type[Config]] = {"paper": PaperConfig, "calibrated": CalibratedConfig}


class Split(NamedTuple):
    """Scenes by use: fitted, validation (early stopping) and held out (reported)."""

    fitted: list[SceneTracks]
    validation: list[SceneTracks]
    held_out: list[SceneTracks]

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the scenes of each part."""
        return {part: [scene.name for scene in scenes] for part, scenes in self._asdict().items()}


def assign_folds(scenes: list[SceneTracks], folds: int) -> list[tuple[str, ...]]:
    """Names of the scenes in each fold, balanced: the largest first, each to the fold with the
    fewest windows so far.

    Raises:
        UserError: fewer than 2 folds, more folds than scenes with windows, or fewer than 3 such
            scenes.
    """
    sizes = {scene.name: count for scene in scenes if (count := count_windows(scene))}
    if not 2 <= folds <= len(sizes) or len(sizes) < 3:
        raise UserError(
            f"folds={folds}: {len(sizes)} recorded scenes have windows to predict; choose 2 to {len(sizes)} folds "
            "of at least 3 scenes."
        )
    names: list[list[str]] = [[] for _ in range(folds)]
    held = [0] * folds
    for name in sorted(sizes, key=lambda name: (-sizes[name], name)):
        fold = held.index(min(held))
        names[fold].append(name)
        held[fold] += sizes[name]
    return [tuple(sorted(fold)) for fold in names]


def split_for_fit(scenes: list[SceneTracks], held_out: tuple[str, ...]) -> Split:
    """The three parts of a fit that reports ``held_out``.

    The smallest of the other scenes are for validation, as few as hold a twelfth of their windows.
    A single other scene is used for both fitting and validation.

    Raises:
        UserError: there is only one scene, a held-out name is not among them, or one of the two
            parts is empty.
    """
    names = [scene.name for scene in scenes]
    if len(names) < 2:
        raise UserError(
            f"recordings of one scene, {', '.join(names)}: one has to be fitted to and another held out; cut it into "
            "several with ganlane prepare ... scene_s=30."
        )
    if unknown := sorted(set(held_out) - set(names)):
        raise UserError(
            f"data.held_out={unknown}: not among the recorded scenes {names}; choose from these."
        )
    others = [scene for scene in scenes if scene.name not in held_out]
    reported = [scene for scene in scenes if scene.name in held_out]
    if not others or not reported:
        raise UserError(
            f"data.held_out={list(held_out)}: of the scenes {names} at least one must be held out and one fitted to; "
            "name some in data.held_out."
        )
    validation = _validation_names(others)
    fitted = [scene for scene in others if scene.name not in validation]
    return Split(
        fitted, [scene for scene in others if scene.name in validation] or fitted, reported
    )


def _validation_names(scenes: list[SceneTracks]) -> set[str]:
    """The smallest of ``scenes`` that together hold a twelfth of the windows; never all of them."""
    sizes = {scene.name: count_windows(scene) for scene in scenes}
    wanted, held, names = VALIDATION_SHARE * sum(sizes.values()), 0, set[str]()
    for name in sorted(sizes, key=lambda name: (sizes[name], name))[:-1]:
        if held >= wanted and held:
            break
        names.add(name)
        held += sizes[name]
    return names if held else set()


def fit_task(config: Config, split: Split) -> Task:
    """The task on the fitted and validation scenes of ``split``."""
    if isinstance(config, PaperConfig):
        return PaperTask(split.fitted, split.validation, config)
    return CalibratedTask(split.fitted, split.validation, config)


def fit_key(config: Config, split: Split) -> str:
    """Hash of everything that a fit depends on.

    Its settings, and the recordings of each part of the split.
    """
    settings = {
        "preset": config.preset,
        "config": json.loads(json.dumps(asdict(config))),
        **split.names,
    }
    scenes = (*split.fitted, *split.validation, *split.held_out)
    return content_hash(
        settings, *(part for scene in scenes for part in (scene.positions, scene.lane))
    )[:12]


def fit_generator(
    preset: Preset,
    frame: pl.DataFrame,
    *,
    held_out: tuple[str, ...] = HELD_OUT,
    config: Config | None = None,
    source: str = "",
    resume_path: str | Path | None = None,
    on_progress: OnProgress | None = None,
) -> FitResult:
    """Fit a generator to recorded trajectories in ``ganlane.data``'s schema.

    The weights are those that were best on the validation scenes, a small part of the scenes that
    are not held out (:func:`split_for_fit`). The metrics are theirs on the held-out scenes, which
    influence neither the weights nor early stopping. The driving statistics are of all scenes.

    Args:
        preset: ``"paper"`` (positions only, open loop) or ``"calibrated"`` (anchored, closed-loop
            rollouts).
        held_out: names of the scenes that are reported.
        source: name of the recordings' file, for the metadata.
        resume_path: file that keeps the state; the fit resumes from it if it exists.
        on_progress: called after every update.

    Raises:
        UserError: unknown preset, a config of the other preset, unusable recordings or scene names.
    """
    expected = _CONFIGS.get(preset)
    if expected is None:
        raise UserError(f"preset {preset!r}: expected one of {sorted(_CONFIGS)}.")
    config = expected() if config is None else config
    if not isinstance(config, expected):
        raise UserError(
            f"config {type(config).__name__}: not the one of preset {preset!r}; give a {expected.__name__}."
        )
    split = split_for_fit(scene_tracks(frame), held_out)
    task = fit_task(config, split)
    loop = FitLoop(task, resume_path)
    loop.run(on_progress)
    return fit_result(loop, split, frame, source, task.metrics(split.held_out), frame)


def fit_result(
    loop: FitLoop,
    split: Split,
    frame: pl.DataFrame,
    source: str,
    metrics: Metrics,
    others: pl.DataFrame,
) -> FitResult:
    """The result of a finished ``loop``; ``others`` are the recordings of the driving statistics."""
    task, tracks = loop.task, frame.select(TRACK).n_unique()
    return FitResult(
        preset=task.config.preset,
        module=task.generator.eval().requires_grad_(False),
        metrics=metrics,
        config=asdict(task.config),
        data={"file": Path(source).name, "rows": frame.height, "tracks": tracks, **split.names},
        statistics=driving_statistics(others).to_dict(),
        updates=loop.best_update,
        seconds=loop.seconds,
    )


class HeldOut(NamedTuple):
    """Windows of held-out scenes and all forecasts of them."""

    windows: Windows
    forecasts: Forecasts


class ScoredFit(NamedTuple):
    """A finished fit and forecasts of its held-out scenes: ``short`` as far as the preset predicts,
    ``long`` for 5 s.

    Long forecasts are made by the calibrated preset only, and only if a vehicle was recorded for
    long enough.
    """

    loop: FitLoop
    short: HeldOut
    long: HeldOut | None


def fit_and_forecast(
    config: Config, split: Split, folder: Path, on_progress: OnProgress | None = None
) -> ScoredFit:
    """Fit to ``split`` and forecast its held-out scenes; resumes from what ``folder`` holds."""
    task = fit_task(config, split)
    path = folder / f"{config.preset}_{fit_key(config, split)}.pt"
    loop = FitLoop(task, path)
    loop.run(on_progress)
    short = _forecasts(path, task, split, config.sizes.predicted, STRIDE)
    frames = OBSERVED_POSITIONS + LONG_STEPS
    far = isinstance(task, CalibratedTask) and any(
        (each.present.sum(0) >= frames).any() for each in split.held_out
    )
    return ScoredFit(
        loop, short, _forecasts(path, task, split, LONG_STEPS, LONG_STRIDE) if far else None
    )


def _forecasts(path: Path, task: Task, split: Split, steps: int, stride: int) -> HeldOut:
    """Forecasts of the held-out windows by the generator, IDM and all baselines, saved next to the
    fit's state.
    """
    path = path.with_name(f"{path.stem}_{steps}.npz")
    windows = cut_windows(split.held_out, stride, OBSERVED_POSITIONS + steps)
    kept = load_arrays(path)
    if kept is not None:
        return HeldOut(windows, kept)
    if isinstance(task, CalibratedTask):
        # the best of 20 is for short forecasts only
        samples = 1 if steps == LONG_STEPS else SAMPLES
        own = calibrated_forecasts(
            task.generator, split.held_out, steps, stride, task.config, samples
        )
    else:
        groups = group_windows(windows, task.config.group_size, task.config.seed)
        own = paper_forecasts(task.generator, windows, groups, task.config.seed)
    baselines = baseline_forecasts(windows, split.fitted + split.validation, stride)
    every = own | baselines | idm_forecasts(split.held_out, steps, stride)
    forecasts = {name: positions.astype(np.float32) for name, positions in every.items()}
    save_arrays(path, forecasts)
    return HeldOut(windows, forecasts)


def pooled(parts: list[HeldOut]) -> tuple[Windows, Forecasts, np.ndarray]:
    """All folds' windows and forecasts, and the fold [W] of each window."""
    forecasts = {
        name: np.concatenate([part.forecasts[name] for part in parts])
        for name in parts[0].forecasts
    }
    fold = np.repeat(np.arange(len(parts)), [len(part.windows) for part in parts])
    return join_windows([part.windows for part in parts]), forecasts, fold


def cross_validate(
    frame: pl.DataFrame,
    config: Config,
    folds: int,
    folder: Path,
    on_fit: OnFit | None = None,
    on_progress: OnProgress | None = None,
    on_fold: Callable[[int, FitResult], None] | None = None,
    source: str = "",
) -> dict[str, Any]:
    """Fit ``folds`` generators, each without its fold's scenes, and score them on these.

    ``on_fold`` gets each fold's number, from 1, and its generator, with driving statistics of its
    other scenes only; ``source`` names the recordings in its metadata.

    Returns:
        ``open_loop`` (:func:`open_loop_scores`), ``splits`` (names of the scenes of each fold's
        parts), and for the calibrated preset ``rollout`` (:func:`long_rollout_scores`).

    Raises:
        UserError: too many folds for the recordings.
    """
    scenes = scene_tracks(frame)
    splits = [split_for_fit(scenes, names) for names in assign_folds(scenes, folds)]
    fits: list[ScoredFit] = []
    for number, split in enumerate(splits, start=1):
        if on_fit is not None:
            on_fit(f"fold {number} of {folds}")
        fit = fit_and_forecast(config, split, folder, on_progress)
        fits.append(fit)
        if on_fold is not None:
            others = frame.filter(~pl.col("scene").is_in(split.names["held_out"]))
            on_fold(number, fit_result(fit.loop, split, frame, source, {}, others))
    open_loop = open_loop_scores(*pooled([fit.short for fit in fits]))
    scores: dict[str, Any] = {"splits": [split.names for split in splits], "open_loop": open_loop}
    if long := [fit.long for fit in fits if fit.long is not None]:
        windows, forecasts, _ = pooled(long)
        scores["rollout"] = long_rollout_scores(windows, forecasts)
    return scores


def variants(config: Config) -> dict[str, Config]:
    """Settings of the ablations by name, with a quarter of the updates.

    The first is the preset itself.
    """
    loop = config.loop
    quarter = {
        name: max(1, getattr(loop, name) // 4) for name in ("updates", "evaluate_every", "warmup")
    }
    config = replace(config, loop=replace(loop, **quarter))
    if isinstance(config, CalibratedConfig):
        return {
            "as it is": config,
            "without washout": replace(config, washout_s=math.inf),
            "without further inputs": replace(config, further_inputs=False),
            "without traits": replace(config, traits=False),
        }
    sizes, weights = config.sizes, config.weights
    return {
        "as it is (p_l = 8)": config,
        "p_l = 4": replace(config, sizes=replace(sizes, predicted=4)),
        "p_l = 12": replace(config, sizes=replace(sizes, predicted=12)),
        "without pooling": replace(config, sizes=replace(sizes, neighbours=0)),
        "without differences as inputs": replace(config, sizes=replace(sizes, differences=False)),
        "without adversarial term": replace(config, weights=replace(weights, adversarial=0.0)),
        "without single-sample term": replace(config, weights=replace(weights, single=0.0)),
        "variety term alone": replace(
            config, weights=replace(weights, single=0.0, mean=0.0, adversarial=0.0)
        ),
        "with history noise of 0.5": replace(config, history_noise=0.5),
    }


def ablate(
    frame: pl.DataFrame,
    config: Config,
    held_out: tuple[str, ...],
    folder: Path,
    on_fit: OnFit | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, dict[str, Any]]:
    """Fit the preset with one part changed at a time to one split, and score every variant on
    ``held_out``.

    Returns:
        Per variant ``windows``, the change of ADE to constant velocity's in %
        (``ade_change_percent``) by kind, over all predicted steps and over the first 0.4 s
        (``ade_change_percent_0.4_s``), and for the calibrated preset ``rmse_5_s_ratio``, the RMSE
        after 5 s divided by constant velocity's.
    """
    split = split_for_fit(scene_tracks(frame), held_out)
    rows = {}
    for name, variant in variants(config).items():
        if on_fit is not None:
            on_fit(name)
        rows[name] = _ablation_row(fit_and_forecast(variant, split, folder, on_progress))
    return rows


def _ablation_row(fit: ScoredFit) -> dict[str, Any]:
    kinds = ("mean", "single", f"best_of_{SAMPLES}", BASELINE)
    errors = errors_of(
        {kind: fit.short.forecasts[kind] for kind in kinds}, fit.short.windows.future
    )
    all_steps = displacement_errors(errors)
    # Predictions of any length can be compared over 0.4 s.
    early = displacement_errors({kind: values[:, :4] for kind, values in errors.items()})
    row = {name: all_steps[name] for name in ("windows", "ade_change_percent")}
    row["ade_change_percent_0.4_s"] = early["ade_change_percent"]
    if fit.long is not None:
        ratio = long_rollout_scores(fit.long.windows, fit.long.forecasts)[
            "ratio_to_constant_velocity"
        ]
        row["rmse_5_s_ratio"] = {kind: ratio[kind] for kind in ("mean", "single")}
    return row
