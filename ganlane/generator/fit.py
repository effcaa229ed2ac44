"""Fits of a preset, scored on the scenes that they have not used.

One split, k folds by scene, or ablations. The state of every fit is kept in a folder under a hash
of recordings and settings: an interrupted run resumes, and nothing is fitted twice.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from sklearn.model_selection import GroupKFold

from ganlane.data import TRACK, driving_statistics
from ganlane.data.dense import Recording
from ganlane.errors import UserError
from ganlane.generator.checkpoint import FitResult, Metrics, load_generator, load_human
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
    repeated,
    scene_metrics,
)
from ganlane.generator.human_estimator import HumanModel
from ganlane.generator.human_fit import fit_human
from ganlane.generator.human_forecasts import (
    fit_observer,
    human_forecasts,
    recording_of,
    tracks_of,
)
from ganlane.generator.tasks import (
    CalibratedTask,
    FitLoop,
    OnProgress,
    PaperTask,
    Progress,
)
from ganlane.generator.windows import (
    OBSERVED_POSITIONS,
    PREDICTED_STEPS,
    SceneTracks,
    Windows,
    count_windows,
    cut_windows,
    group_windows,
    join_windows,
    scene_tracks,
)
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.generator import (
    GENERATOR,
    HUMAN,
    CalibratedConfig,
    HumanConfig,
    HumanSizes,
    PaperConfig,
    shipped_generator,
)
from ganlane.weights import save_weights

NetworkConfig = PaperConfig | CalibratedConfig
Config = NetworkConfig | HumanConfig

#: Scenes that are held out by default.
HELD_OUT = ("us101-b", "us101-e", "us101-h", "us101-i")
#: Least share of the remaining windows that the validation scenes hold.
VALIDATION_SHARE = 1 / 12
#: Frames between the starts of two scored windows, the same for both presets.
STRIDE = 3
#: Steps of the long rollouts (5 s), and frames between their starts.
LONG_STEPS = 50
LONG_STRIDE = 5


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
    """Names of the scenes in each fold, with about as many windows in each.

    Raises:
        UserError: fewer than 2 folds, more folds than scenes with windows, or fewer than 3 such
            scenes.
    """
    # A scene too short for one window has nothing to be scored on.
    sizes = {scene.name: count for scene in scenes if (count := count_windows(scene))}
    if not 2 <= folds <= len(sizes) or len(sizes) < 3:
        raise UserError(
            f"folds={folds}: {len(sizes)} recorded scenes have windows to predict; "
            f"choose 2 to {len(sizes)} folds of at least 3 scenes."
        )
    # One entry per window, so that the folds get about as many windows each.
    scene_of = np.repeat(list(sizes), list(sizes.values()))
    # GroupKFold draws nothing at random: the same recordings always get the same folds.
    splits = GroupKFold(folds).split(scene_of, groups=scene_of)
    return [tuple(np.unique(scene_of[tested]).tolist()) for _, tested in splits]


def split_for_fit(scenes: list[SceneTracks], held_out: tuple[str, ...]) -> Split:
    """The three parts of a fit that reports ``held_out``.

    The smallest of the other scenes are for validation, as few as hold a twelfth of their windows.
    A single other scene is used for both fitting and validation.

    Raises:
        UserError: there is only one scene, a held-out name is not among them, or one of the two
            parts is empty.
    """
    # A held-out scene must be another one than those fitted to.
    names = [scene.name for scene in scenes]
    if len(names) < 2:
        raise UserError(
            f"recordings of one scene, {', '.join(names)}: one has to be fitted to and another "
            "held out; cut it into several with ganlane prepare ... scene_s=30."
        )
    if unknown := sorted(set(held_out) - set(names)):
        raise UserError(
            f"data.held_out={unknown}: not among the recorded scenes {names}; choose from these."
        )

    others = [scene for scene in scenes if scene.name not in held_out]
    reported = [scene for scene in scenes if scene.name in held_out]
    if not others or not reported:
        raise UserError(
            f"data.held_out={list(held_out)}: of the scenes {names} at least one must be held out "
            "and one fitted to; name some in data.held_out."
        )

    chosen = _validation_names(others)
    fitted = [scene for scene in others if scene.name not in chosen]
    validation = [scene for scene in others if scene.name in chosen]
    return Split(fitted, validation or fitted, reported)


def _validation_names(scenes: list[SceneTracks]) -> set[str]:
    """The smallest of ``scenes`` that together hold a twelfth of the windows; never all of them."""
    # The smallest scenes cost the fit least.
    sizes = {scene.name: count_windows(scene) for scene in scenes}
    wanted = VALIDATION_SHARE * sum(sizes.values())
    held = 0
    names = set[str]()
    # The largest is left for the fit, however little the others hold.
    for name in sorted(sizes, key=lambda name: (sizes[name], name))[:-1]:
        if held >= wanted:
            break
        names.add(name)
        held += sizes[name]
    return names if held else set()


def fit_key(config: Config, split: Split) -> str:
    """Hash of all that a fit depends on: its settings, and the recordings of each part."""
    # Folder and display change no weights, so they stay out of the hash.
    settings = {
        "preset": config.preset,
        "config": asdict(config),
        **split.names,
    }
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for scene in (
        *split.fitted,
        *split.validation,
        *split.held_out,
    ):
        # What is cut from a scene follows from its positions and lanes.
        for array in (scene.positions, scene.lane):
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data)
    # 12 hexadecimal digits are 48 bits: enough to tell fits apart, short enough for a file name.
    return digest.hexdigest()[:12]


class HumanTask(NamedTuple):
    """A fitted ``human``, scored as the other presets are."""

    config: HumanConfig
    generator: HumanModel

    def metrics(self, scenes: list[SceneTracks]) -> Metrics:
        """Errors over 0.8 s of the mean driver, of drawn ones and of constant velocity."""
        windows = cut_windows(scenes, STRIDE)
        forecasts = human_forecasts(self.generator, scenes, PREDICTED_STEPS, STRIDE)
        forecasts[BASELINE] = repeated(windows.past[:, -1], PREDICTED_STEPS)
        return scene_metrics(windows, forecasts)


#: Segments of a site that are forecast, at most: the first ones of each.
SITE_SCENES = 400
#: Frames between two forecasts of 0.8 and of 5 s at other sites.
SITE_STRIDES = {PREDICTED_STEPS: 10, LONG_STEPS: 25}


def site_scores(
    model: HumanModel, sites: Mapping[str, Sequence[Recording]]
) -> dict[str, dict[str, float]]:
    """Forecasts of sites that ``model`` was not fitted to, by site.

    Of the cars that follow, not of those whose own leaders were not recorded. Windows; constant
    velocity's ADE over 0.8 s and RMSE at 5 s, m; and by forecaster both errors over constant
    velocity's: the mean driver, ``gan_calibrated`` as it ships, and IDM with each driver's own
    headway.
    """
    calibrated, _ = load_generator(shipped_generator("calibrated"), "calibrated")
    settings = CalibratedConfig()
    scores: dict[str, dict[str, float]] = {}
    for site, recordings in sites.items():
        recordings = recordings[:SITE_SCENES]
        scenes = [tracks_of(recording) for recording in recordings]
        driven = {recording.name: recording.driven for recording in recordings}
        row = scores[site] = {}
        for steps, stride in SITE_STRIDES.items():
            windows = cut_windows(scenes, stride, OBSERVED_POSITIONS + steps)
            baseline = repeated(windows.past[:, -1], steps)
            forecasts = {
                "human": human_forecasts(model, scenes, steps, stride, samples=1)["mean"],
                "gan_calibrated": calibrated_forecasts(
                    calibrated, scenes, steps, stride, settings, samples=1
                )["mean"],
                "idm_own_headway": idm_forecasts(scenes, steps, stride)["idm_own_headway"],
            }
            name = f"{steps * PHYSICS_STEP_S:g} s"
            follows = [driven[scene][car] for scene, car in zip(windows.scene, windows.vehicle)]
            recorded = windows.future[follows]

            def error(
                positions: np.ndarray,
                recorded: np.ndarray = recorded,
                follows: list[bool] = follows,
            ) -> float:
                distance = np.linalg.norm(positions[follows] - recorded, axis=-1)
                if distance.shape[1] == PREDICTED_STEPS:
                    return float(distance.mean())
                return float(np.sqrt(np.square(distance[:, -1]).mean()))

            of_baseline = error(baseline)
            row |= {f"windows, {name}": len(recorded), f"constant velocity, {name}, m": of_baseline}
            row |= {f"{of}, {name}": error(its) / of_baseline for of, its in forecasts.items()}
    return scores


class Fitted(NamedTuple):
    """A finished fit of ``human``; the fields are those of a :class:`FitLoop`."""

    task: HumanTask
    best_update: int
    seconds: float


def run_fit(
    config: Config,
    split: Split,
    folder: Path | None = None,
    on_progress: OnProgress | None = None,
    name: str = "fit",
    following: Sequence[Recording] = (),
) -> FitLoop | Fitted:
    """Fit to ``split`` until it stops improving; the state in ``folder`` is resumed from.

    ``human`` stops after its schedule, and a finished fit of it in ``folder`` is taken again.
    """
    # The key names the fit, so other settings or recordings never resume a foreign state.
    if isinstance(config, HumanConfig):
        return _run_human(config, split, folder, on_progress, name, following)
    path = None if folder is None else folder / f"{config.preset}_{fit_key(config, split)}.pt"
    if isinstance(config, PaperConfig):
        loop = FitLoop(
            PaperTask(split.fitted, split.validation, config),
            path,
            name,
        )
    else:
        loop = FitLoop(
            CalibratedTask(split.fitted, split.validation, config),
            path,
            name,
        )
    loop.run(on_progress)
    return loop


def _run_human(
    config: HumanConfig,
    split: Split,
    folder: Path | None,
    on_progress: OnProgress | None,
    name: str,
    following: Sequence[Recording],
) -> Fitted:
    """Fit ``human`` to all scenes that are not held out, or take the finished fit."""
    key = f"{config.preset}_{fit_key(config, split)}_{len(following)}"
    path = None if folder is None else folder / f"{key}.safetensors"
    if path is not None and path.exists():
        model, metadata = load_human(path)
        return Fitted(HumanTask(config, model), metadata["steps"], metadata["seconds"])
    begun = time.monotonic()
    best = math.inf

    def report(done: int, steps: int, cost: float | None) -> None:
        nonlocal best
        best = best if cost is None else min(best, cost)
        if on_progress is not None:
            seconds = time.monotonic() - begun
            on_progress(Progress(name, done, steps, {}, cost, best, seconds))

    # No scene stops it early, so those for validation are fitted to, too.
    scenes = {scene.name: scene for scene in (*split.fitted, *split.validation)}
    recordings = [recording_of(scene) for scene in scenes.values()]
    model, seconds = fit_human(config, recordings, following, report)
    fit_observer(model, list(scenes.values()), config)
    steps = 1 + config.rounds + config.tuning
    if path is not None:
        metadata = {"preset": HUMAN, "sizes": asdict(config.sizes)}
        metadata |= {"steps": steps, "seconds": seconds}
        save_weights(path, GENERATOR, model.state_dict(), metadata)
    return Fitted(HumanTask(config, model), steps, seconds)


def fit_generator(
    config: Config,
    frame: pl.DataFrame,
    held_out: tuple[str, ...] = HELD_OUT,
    folder: Path | None = None,
    on_progress: OnProgress | None = None,
    source: str = "",
    following: Sequence[Recording] = (),
) -> FitResult:
    """Fit a generator to recorded trajectories in ``ganlane.data``'s schema.

    The weights are those that were best on the validation scenes, a small part of the scenes that
    are not held out (:func:`split_for_fit`). The metrics are theirs on the held-out scenes, which
    influence neither the weights nor early stopping. The driving statistics are of all scenes.

    Args:
        config: :class:`PaperConfig` (positions only, open loop), :class:`CalibratedConfig`
            (anchored, closed-loop rollouts) or :class:`HumanConfig` (a policy).
        frame: the recordings.
        held_out: names of the scenes that are reported.
        folder: where the state is kept; the fit resumes from it.
        on_progress: called after every update.
        source: name of the recordings' file, for the metadata.
        following: cars that follow each other in one lane, for ``human``.

    Raises:
        UserError: unusable recordings or scene names.
    """
    split = split_for_fit(scene_tracks(frame), held_out)
    loop = run_fit(config, split, folder, on_progress, following=following)
    return _fit_result(
        loop,
        split,
        frame,
        source,
        loop.task.metrics(split.held_out),
        frame,
    )


def _fit_result(
    loop: FitLoop | Fitted,
    split: Split,
    frame: pl.DataFrame,
    source: str,
    metrics: Metrics,
    driven: pl.DataFrame,
) -> FitResult:
    """The result of a finished ``loop``; its driving statistics are those of ``driven``."""
    task = loop.task
    data = {
        "file": Path(source).name,
        "rows": frame.height,
        "tracks": frame.select(TRACK).n_unique(),
        **split.names,
    }
    return FitResult(
        config=task.config,
        # In evaluation mode and without gradients, as load_generator returns it.
        module=task.generator.eval().requires_grad_(False),
        metrics=metrics,
        data=data,
        statistics=driving_statistics(driven).to_dict(),
        updates=loop.best_update,
        seconds=loop.seconds,
    )


class HeldOut(NamedTuple):
    """Windows of held-out scenes and all forecasts of them."""

    windows: Windows
    forecasts: Forecasts


def _held_out(
    task: PaperTask | CalibratedTask | HumanTask,
    split: Split,
    steps: int,
    stride: int,
) -> HeldOut:
    """Forecasts of the held-out windows by the generator, IDM and all baselines."""
    # The same windows for every forecaster, in the same order.
    windows = cut_windows(split.held_out, stride, OBSERVED_POSITIONS + steps)
    if isinstance(task, CalibratedTask):
        # The best of 20 is for short forecasts only.
        samples = 1 if steps == LONG_STEPS else SAMPLES
        forecasts = calibrated_forecasts(
            task.generator,
            split.held_out,
            steps,
            stride,
            task.config,
            samples,
        )
    elif isinstance(task, HumanTask):
        forecasts = human_forecasts(task.generator, split.held_out, steps, stride)
    else:
        groups = group_windows(windows, task.config.group_size, task.config.seed)
        forecasts = paper_forecasts(
            task.generator,
            windows,
            groups,
            task.config.seed,
        )
    # Baselines may learn from all scenes but the held-out ones.
    forecasts |= baseline_forecasts(windows, split.fitted + split.validation, stride)
    forecasts |= idm_forecasts(split.held_out, steps, stride)
    # Half the memory: the windows of all folds are held at the same time.
    forecasts = {name: positions.astype(np.float32) for name, positions in forecasts.items()}
    return HeldOut(windows, forecasts)


def short_forecasts(task: PaperTask | CalibratedTask | HumanTask, split: Split) -> HeldOut:
    """Forecasts of the held-out scenes as far as the preset predicts; of ``human`` for 0.8 s."""
    sizes = task.config.sizes
    steps = PREDICTED_STEPS if isinstance(sizes, HumanSizes) else sizes.predicted
    return _held_out(task, split, steps, STRIDE)


def long_forecasts(task: PaperTask | CalibratedTask | HumanTask, split: Split) -> HeldOut | None:
    """Forecasts of the held-out scenes for 5 s.

    Not by the paper's preset, and only if a vehicle was recorded for long enough.
    """
    frames = OBSERVED_POSITIONS + LONG_STEPS
    # A window of 5 s needs the observed positions before it as well.
    recorded = any((scene.present.sum(0) >= frames).any() for scene in split.held_out)
    if isinstance(task, PaperTask) or not recorded:
        return None
    return _held_out(
        task,
        split,
        LONG_STEPS,
        LONG_STRIDE,
    )


def pooled(parts: list[HeldOut]) -> HeldOut:
    """All folds' windows and forecasts."""
    forecasts = {
        name: np.concatenate([part.forecasts[name] for part in parts])
        for name in parts[0].forecasts
    }
    return HeldOut(join_windows([part.windows for part in parts]), forecasts)


def cross_validate(
    config: Config,
    frame: pl.DataFrame,
    folds: int,
    folder: Path,
    on_progress: OnProgress | None = None,
    source: str = "",
    following: Sequence[Recording] = (),
) -> tuple[dict[str, Any], list[FitResult]]:
    """Fit ``folds`` generators, each without its fold's scenes, and score them on these.

    Returns:
        The scores: ``open_loop`` (:func:`open_loop_scores`), ``splits`` (names of the scenes of
        each fold's parts), and for the calibrated preset ``rollout``
        (:func:`long_rollout_scores`). Then each fold's generator, with driving statistics of its
        other scenes only and ``source`` as the recordings' name.

    Raises:
        UserError: too many folds for the recordings.
    """
    scenes = scene_tracks(frame)
    splits = [split_for_fit(scenes, names) for names in assign_folds(scenes, folds)]
    # short: as far as the preset predicts; long: 5 s, by the calibrated preset alone.
    results = []
    short = []
    long = []
    for number, split in enumerate(splits, start=1):
        loop = run_fit(
            config,
            split,
            folder,
            on_progress,
            f"fold {number} of {folds}",
            following,
        )
        # A fold's statistics must not know its held-out scenes either.
        others = frame.filter(~pl.col("scene").is_in(split.names["held_out"]))
        results.append(_fit_result(loop, split, frame, source, {}, others))
        short.append(short_forecasts(loop.task, split))
        if rollout := long_forecasts(loop.task, split):
            long.append(rollout)

    # All folds are scored together; each window was held out in one of them.
    fold = np.repeat(np.arange(folds), [len(part.windows) for part in short])
    scores: dict[str, Any] = {
        "splits": [split.names for split in splits],
        "open_loop": open_loop_scores(*pooled(short), fold),
    }
    if long:
        scores["rollout"] = long_rollout_scores(*pooled(long))
        scores["rollout"]["folds"] = [
            long_rollout_scores(*part)["ratio_to_constant_velocity"] for part in long
        ]
    return scores, results


def variants(config: NetworkConfig) -> dict[str, NetworkConfig]:
    """Settings of the ablations by name, with a quarter of the updates.

    The first is the preset itself.
    """
    # All parts of the schedule shrink alike, so that warm-up and evaluations keep their share.
    loop = replace(
        config.loop,
        updates=max(1, config.loop.updates // 4),
        evaluate_every=max(1, config.loop.evaluate_every // 4),
        warmup=max(1, config.loop.warmup // 4),
    )
    config = replace(config, loop=loop)
    if isinstance(config, CalibratedConfig):
        return {
            "as it is": config,
            "without washout": replace(config, washout_s=math.inf),
            "without further inputs": replace(config, further_inputs=False),
            "without traits": replace(config, traits=False),
        }
    sizes = config.sizes
    weights = config.weights
    # What remains is the variety term.
    alone = replace(
        weights,
        single=0.0,
        mean=0.0,
        adversarial=0.0,
    )
    return {
        "as it is (p_l = 8)": config,
        "p_l = 4": replace(config, sizes=replace(sizes, predicted=4)),
        "p_l = 12": replace(config, sizes=replace(sizes, predicted=12)),
        "without pooling": replace(config, sizes=replace(sizes, neighbours=0)),
        "without differences as inputs": replace(config, sizes=replace(sizes, differences=False)),
        "without adversarial term": replace(config, weights=replace(weights, adversarial=0.0)),
        "without single-sample term": replace(config, weights=replace(weights, single=0.0)),
        "variety term alone": replace(config, weights=alone),
        "with history noise of 0.5": replace(config, history_noise=0.5),
    }


def ablate(
    config: NetworkConfig,
    frame: pl.DataFrame,
    held_out: tuple[str, ...],
    folder: Path,
    on_progress: OnProgress | None = None,
) -> dict[str, dict[str, Any]]:
    """Fit the preset with one part changed at a time, and score every variant on ``held_out``.

    Returns:
        Per variant ``windows``, the change of ADE to constant velocity's in %
        (``ade_change_percent``) by kind, over all predicted steps and over the first 0.4 s
        (``ade_change_percent_0.4_s``), and for the calibrated preset ``rmse_5_s_ratio``, the RMSE
        after 5 s divided by constant velocity's.
    """
    split = split_for_fit(scene_tracks(frame), held_out)
    rows = {}
    for name, variant in variants(config).items():
        # The name is for the display; every variant's state has a hash of its own.
        task = run_fit(variant, split, folder, on_progress, name).task
        windows, forecasts = short_forecasts(task, split)
        # The generator's kinds, and what every change is relative to.
        kinds = ("mean", "single", f"best_of_{SAMPLES}", BASELINE)
        errors = errors_of(
            {kind: forecasts[kind] for kind in kinds},
            windows.future,
        )
        # Predictions of any length can be compared over 0.4 s.
        early = {kind: values[:, :4] for kind, values in errors.items()}
        scores = displacement_errors(errors)
        row = {
            "windows": scores["windows"],
            "ade_change_percent": scores["ade_change_percent"],
            "ade_change_percent_0.4_s": displacement_errors(early)["ade_change_percent"],
        }
        if rollout := long_forecasts(task, split):
            ratio = long_rollout_scores(*rollout)["ratio_to_constant_velocity"]
            row["rmse_5_s_ratio"] = {kind: ratio[kind] for kind in ("mean", "single")}
        rows[name] = row
    return rows
