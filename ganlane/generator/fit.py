"""Fitting a preset to recordings: scenes are split, a preset is fitted to some of them and measured on others."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import polars as pl

from ganlane.data import TRACK, driving_statistics
from ganlane.errors import UserError
from ganlane.generator.checkpoint import FitResult, Preset
from ganlane.generator.forecasts import Metrics
from ganlane.generator.loop import FitLoop, OnProgress
from ganlane.generator.segments import SceneTracks, scene_tracks
from ganlane.generator.tasks import CalibratedTask, PaperTask
from ganlane.generator.windows import content_hash, count_windows
from ganlane.parameters.generator import CalibratedConfig, PaperConfig

#: Scenes that are held out by default.
HELD_OUT = ("us101-b", "us101-e", "us101-h", "us101-i")
#: Least share of the remaining windows that the validation scenes hold.
VALIDATION_SHARE = 1 / 12
Config = PaperConfig | CalibratedConfig
Task = PaperTask | CalibratedTask
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
    """Names of the scenes in each fold, balanced: the largest first, each to the fold with the fewest windows so far.

    Raises:
        UserError: fewer than 2 folds, more folds than scenes with windows, or fewer than 3 such scenes.
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

    The smallest of the other scenes are for validation, as few as hold a twelfth of their windows. A single other
    scene is used for both fitting and validation.

    Raises:
        UserError: there is only one scene, a held-out name is not among them, or one of the two parts is empty.
    """
    names = [scene.name for scene in scenes]
    if len(names) < 2:
        raise UserError(
            f"recordings of one scene, {', '.join(names)}: one has to be fitted to and another held out; cut it into "
            "several with ganlane prepare ... scene_s=30."
        )
    unknown = sorted(set(held_out) - set(names))
    if unknown:
        raise UserError(f"data.held_out={unknown}: not among the recorded scenes {names}; choose from these.")
    others = [scene for scene in scenes if scene.name not in held_out]
    reported = [scene for scene in scenes if scene.name in held_out]
    if not others or not reported:
        raise UserError(
            f"data.held_out={list(held_out)}: of the scenes {names} at least one must be held out and one fitted to; "
            "name some in data.held_out."
        )
    validation = _validation_names(others)
    fitted = [scene for scene in others if scene.name not in validation]
    return Split(fitted, [scene for scene in others if scene.name in validation] or fitted, reported)


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
    """Hash of everything that a fit depends on: its settings, and the recordings of each part of the split."""
    settings = {"preset": config.preset, "config": json.loads(json.dumps(asdict(config))), **split.names}
    scenes = (*split.fitted, *split.validation, *split.held_out)
    return content_hash(settings, *(part for scene in scenes for part in (scene.positions, scene.lane)))[:12]


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
    """Fit a generator to recorded trajectories.

    The weights are those that were best on the validation scenes, a small part of the scenes that are not held out
    (:func:`split_for_fit`). The metrics are theirs on the held-out scenes, which influence neither the weights nor
    early stopping. The driving statistics are of all scenes.

    Args:
        preset: ``"paper"`` (positions only, open loop) or ``"calibrated"`` (anchored, closed-loop rollouts).
        frame: recordings in ``ganlane.data``'s schema.
        held_out: names of the scenes that are reported, used for neither fitting nor early stopping.
        config: :class:`PaperConfig` or :class:`CalibratedConfig`, by preset; its defaults if None.
        source: name of the recordings' file, for the metadata.
        resume_path: file that keeps the state; the fit resumes from it if it exists.
        on_progress: called after every update.

    Raises:
        UserError: unknown preset, a config of the other preset, unusable recordings or scene names.
    """
    if preset not in _CONFIGS:
        raise UserError(f"preset {preset!r}: expected one of {sorted(_CONFIGS)}.")
    expected = _CONFIGS[preset]
    config = expected() if config is None else config
    if not isinstance(config, expected):
        raise UserError(
            f"config {type(config).__name__}: not the one of preset {preset!r}; give a {expected.__name__}."
        )
    split = split_for_fit(scene_tracks(frame), held_out)
    task = fit_task(config, split)
    loop = FitLoop(task, config.loop, resume_path)
    loop.run(on_progress)
    return fit_result(task, loop, split, frame, source, task.metrics(split.held_out))


def fit_result(
    task: Task,
    loop: FitLoop,
    split: Split,
    frame: pl.DataFrame,
    source: str,
    metrics: Metrics,
    statistics_of: pl.DataFrame | None = None,
) -> FitResult:
    """The result of a finished ``loop``; ``statistics_of`` are the recordings of the driving statistics, else all."""
    return FitResult(
        preset=task.config.preset,
        module=task.generator.eval().requires_grad_(False),
        metrics=metrics,
        config=asdict(task.config),
        data={
            "file": Path(source).name,
            "rows": frame.height,
            "tracks": frame.select(TRACK).n_unique(),
            **split.names,
        },
        statistics=driving_statistics(frame if statistics_of is None else statistics_of).to_dict(),
        updates=loop.best_update,
        seconds=loop.seconds,
    )
