"""Fits of a preset, scored on the scenes that they have not used.

One split, or k folds by scene. Every finished fit is kept in a folder under a hash of recordings
and settings, so that nothing is fitted twice.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from sklearn.model_selection import GroupKFold

from ganlane.data import TRACK, driving_statistics
from ganlane.data.dense import Recording, recordings_of
from ganlane.errors import UserError
from ganlane.generator.checkpoint import FitResult
from ganlane.generator.forecasts import (
    BASELINE,
    SAMPLES,
    Forecasts,
    by_kind,
    displacement_errors,
    driven_windows,
    errors_of,
    idm_driver,
    long_errors,
    repeated,
)
from ganlane.generator.tasks import CalibratedTask, HumanTask, OnProgress, PaperTask
from ganlane.generator.windows import (
    OBSERVED_POSITIONS,
    PREDICTED_STEPS,
    Windows,
    count_windows,
    cut_windows,
)
from ganlane.settings.generator import CalibratedConfig, HumanConfig, PaperConfig
from ganlane.weights import load_weights, save_weights

Config = PaperConfig | CalibratedConfig | HumanConfig
Task = PaperTask | CalibratedTask | HumanTask
#: Kind of the files of finished fits.
FIT = "fit"
#: Frames between the starts of two scored windows, the same for all presets.
STRIDE = 3
#: Scenes that are held out by default.
HELD_OUT = ("us101-b", "us101-e", "us101-h", "us101-i")
#: Least share of the remaining windows that the validation scenes hold.
VALIDATION_SHARE = 1 / 12
#: Steps of the long rollouts: 5 s.
LONG_STEPS = 50
#: Frames between their starts.
LONG_STRIDE = 5


class Split(NamedTuple):
    """Scenes by use.

    Attributes:
        fitted: what the generator learns from.
        validation: what stops a fit early.
        held_out: what is reported.
    """

    fitted: list[Recording]
    validation: list[Recording]
    held_out: list[Recording]

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the scenes of each part."""
        names = {}
        for part, scenes in self._asdict().items():
            names[part] = [scene.name for scene in scenes]
        return names


def assign_folds(scenes: list[Recording], folds: int) -> list[tuple[str, ...]]:
    """Names of the scenes in each fold, with about as many windows in each.

    Raises:
        UserError: fewer than 2 folds, more folds than scenes with windows, or fewer than 3 such
            scenes.
    """
    sizes = {}
    for scene in scenes:
        windows = count_windows(scene)
        # A scene too short for one window has nothing to be scored on.
        if windows:
            sizes[scene.name] = windows
    if not 2 <= folds <= len(sizes) or len(sizes) < 3:
        raise UserError(
            f"folds={folds}: {len(sizes)} recorded scenes have windows to predict; "
            f"choose 2 to {len(sizes)} folds of at least 3 scenes."
        )

    # One entry per window, so that the folds get about as many windows each.
    scene_of = np.repeat(list(sizes), list(sizes.values()))
    # GroupKFold draws nothing at random: the same recordings always get the same folds.
    splits = GroupKFold(folds).split(scene_of, groups=scene_of)

    names = []
    for _, tested in splits:
        names.append(tuple(np.unique(scene_of[tested]).tolist()))
    return names


def split_for_fit(scenes: list[Recording], held_out: tuple[str, ...]) -> Split:
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


def _validation_names(scenes: list[Recording]) -> set[str]:
    """The smallest of ``scenes`` that together hold a twelfth of the windows; never all of them."""
    # The smallest scenes cost the fit least; of equal ones, the order of their names decides.
    sizes = {scene.name: count_windows(scene) for scene in scenes}
    ascending = sorted(sizes, key=lambda name: (sizes[name], name))
    wanted = VALIDATION_SHARE * sum(sizes.values())

    held = 0
    names = set[str]()
    # The largest is left for the fit, however little the others hold.
    for name in ascending[:-1]:
        if held >= wanted:
            break
        names.add(name)
        held += sizes[name]
    # Scenes without a window say nothing.
    return names if held else set()


def fit_key(config: Config, split: Split, following: Sequence[Recording]) -> str:
    """Hash of all that a fit depends on: its settings, and the recordings of each part.

    It is the same for as long as these are, so a finished fit is recognised by it.
    """
    # Folder and display change no weights, so they stay out of the hash.
    settings = {
        "config": asdict(config),
        "following": len(following),
        **split.names,
    }
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())

    for scene in (*split.fitted, *split.validation, *split.held_out):
        # What is cut from a scene follows from its positions and lanes.
        for array in (scene.positions, scene.lane):
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data)
    # 12 hexadecimal digits are 48 bits: enough to tell fits apart, short enough for a file name.
    return digest.hexdigest()[:12]


def run_fit(
    config: Config,
    split: Split,
    folder: Path | None,
    on_progress: OnProgress,
    name: str,
    following: Sequence[Recording],
) -> tuple[Task, int, float]:
    """Fit to ``split``; what was fitted with ``folder`` before is taken from there.

    Args:
        config: settings of the fit, by whose type the preset is chosen.
        split: the scenes.
        folder: where finished fits are kept; None: nowhere.
        on_progress: called after every update; never, if there is nothing to do.
        name: of the fit, for its reports.
        following: cars that follow each other in one lane, for ``human``.

    Returns:
        The networks, the updates until they were best, and how long it took, s.
    """
    task: Task
    if isinstance(config, HumanConfig):
        # No scene stops it early, so those for validation are fitted to, too.
        scenes = {scene.name: scene for scene in (*split.fitted, *split.validation)}
        task = HumanTask(list(scenes.values()), following, config)
    elif isinstance(config, PaperConfig):
        task = PaperTask(split.fitted, split.validation, config)
    else:
        task = CalibratedTask(split.fitted, split.validation, config)

    path = None
    if folder is not None:
        # The key names the fit, so other settings or recordings never take a foreign one.
        key = fit_key(config, split, following)
        path = folder / f"{config.preset}_{key}.safetensors"
        if path.is_file():
            weights, description = load_weights(path, FIT)
            task.load_state_dict(weights)
            return task, description["updates"], description["seconds"]

    begun = time.monotonic()
    updates = task.fit(name, on_progress)
    seconds = time.monotonic() - begun

    if path is not None:
        description = {"updates": updates, "seconds": seconds}
        save_weights(path, FIT, task.state_dict(), description)
    return task, updates, seconds


def fit_generator(
    config: Config,
    frame: pl.DataFrame,
    held_out: tuple[str, ...] = HELD_OUT,
    folder: Path | None = None,
    on_progress: OnProgress = lambda progress: None,
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
        folder: where the finished fit is kept; it is not repeated.
        on_progress: called after every update.
        source: name of the recordings' file, for the metadata.
        following: cars that follow each other in one lane, for ``human``.

    Raises:
        UserError: unusable recordings or scene names.
    """
    split = split_for_fit(recordings_of(frame), held_out)
    task, updates, seconds = run_fit(config, split, folder, on_progress, "fit", following)
    held = held_out_errors(task, split.held_out, predicted_steps(config), STRIDE)
    _, errors = held
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
        metrics={"all": displacement_errors(errors), **errors_by_scene(held)},
        data=data,
        statistics=driving_statistics(frame).to_dict(),
        updates=updates,
        seconds=seconds,
    )


def predicted_steps(config: Config) -> int:
    """Steps of the short forecasts: those that a generator predicts."""
    return PREDICTED_STEPS if isinstance(config, HumanConfig) else config.sizes.predicted


#: Scene of each window [W], and errors [W, T] in m of every forecast.
HeldOut = tuple[np.ndarray, Forecasts]


def held_out_errors(
    task: Task,
    scenes: list[Recording],
    steps: int,
    stride: int,
) -> HeldOut:
    """Errors of forecasts of held-out scenes: by the fit, constant velocity and IDM.

    Args:
        task: what was fitted.
        scenes: that it was not fitted to.
        steps: of the forecasts, 0.1 s each.
        stride: frames between the starts of two windows.
    """
    # The best of 20 is for short forecasts only; the policy draws many in any case.
    drawn = SAMPLES
    if steps == LONG_STEPS and isinstance(task, CalibratedTask):
        drawn = 1

    # The same windows for every forecaster, in the same order.
    windows = cut_windows(scenes, stride, OBSERVED_POSITIONS + steps)
    samples = task.forecasts(scenes, steps, stride, drawn)
    forecasts = by_kind(samples, windows.future)
    errors = errors_beside_references(forecasts, windows, scenes, stride)
    return windows.scene, errors


def errors_beside_references(
    forecasts: Forecasts,
    windows: Windows,
    scenes: list[Recording],
    stride: int,
) -> Forecasts:
    """Errors of forecasts, of constant velocity's and of IDM's with each driver's own headway.

    Args:
        forecasts: of all windows.
        windows: of the scenes.
        scenes: recordings.
        stride: frames between the starts of two windows.
    """
    steps = windows.future.shape[1]
    (of_idm,) = driven_windows(idm_driver, scenes, steps, stride)
    references = {
        BASELINE: repeated(windows.past[:, -1], steps),
        "idm_own_headway": of_idm,
    }
    return errors_of({**forecasts, **references}, windows.future)


def errors_by_scene(held: HeldOut) -> dict[str, Any]:
    """:func:`displacement_errors` of each scene, by its name."""
    scene, errors = held
    by_name = {}
    for name in np.unique(scene):
        by_name[str(name)] = displacement_errors(errors, scene == name)
    return by_name


def pooled(parts: list[HeldOut]) -> HeldOut:
    """The windows of all folds, one fold after the other."""
    scenes, errors = zip(*parts)
    of_all = {}
    for name in errors[0]:
        of_all[name] = np.concatenate([part[name] for part in errors])
    return np.concatenate(scenes), of_all


def cross_validate(
    config: Config,
    frame: pl.DataFrame,
    folds: int,
    folder: Path,
    on_progress: OnProgress = lambda progress: None,
    following: Sequence[Recording] = (),
) -> dict[str, Any]:
    """Fit ``folds`` generators, each without its fold's scenes, and score them on these.

    Args:
        config: settings of all fits, as in :func:`fit_generator`.
        frame: the recordings.
        folds: how many generators.
        folder: where finished fits are kept; they are not repeated.
        on_progress: called after every update.
        following: cars that follow each other in one lane, for ``human``.

    Returns:
        ``open_loop`` (:func:`displacement_errors`, of all windows, by fold and by scene),
        ``splits`` (names of the scenes of each fold's parts), and ``rollout``
        (:func:`long_errors`) where 5 s were recorded, but not of the paper's preset.

    Raises:
        UserError: too many folds for the recordings.
    """
    scenes = recordings_of(frame)
    splits = [split_for_fit(scenes, names) for names in assign_folds(scenes, folds)]
    # A window of 5 s needs the observed positions before it as well.
    long_frames = OBSERVED_POSITIONS + LONG_STEPS

    # Errors of the forecasts of 0.8 s and of 5 s, by fold.
    short = []
    long = []
    for number, split in enumerate(splits, start=1):
        name = f"fold {number} of {folds}"
        task, _, _ = run_fit(config, split, folder, on_progress, name, following)
        short.append(held_out_errors(task, split.held_out, predicted_steps(config), STRIDE))

        recorded = any((scene.present.sum(0) >= long_frames).any() for scene in split.held_out)
        if recorded and not isinstance(config, PaperConfig):
            long.append(held_out_errors(task, split.held_out, LONG_STEPS, LONG_STRIDE))

    # All folds are scored together; each window was held out in one of them.
    held = pooled(short)
    _, errors = held
    by_fold = {}
    for number, (_, part) in enumerate(short):
        by_fold[str(number)] = displacement_errors(part)
    scores: dict[str, Any] = {
        "splits": [split.names for split in splits],
        "open_loop": {
            **displacement_errors(errors),
            "folds": by_fold,
            "scenes": errors_by_scene(held),
        },
    }

    if long:
        _, errors = pooled(long)
        ratios = [long_errors(part)["ratio_to_constant_velocity"] for _, part in long]
        scores["rollout"] = {**long_errors(errors), "folds": ratios}
    return scores
