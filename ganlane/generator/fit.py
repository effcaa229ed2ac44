"""Fitting a preset to recordings: scenes are split, the loop fits a preset to some of them, it is measured on others.

The loop of both presets: updates, evaluations on validation scenes, early stopping, resuming.
"""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl
import torch
from torch import Tensor

from ganlane.data import TRACK, driving_statistics
from ganlane.errors import UserError
from ganlane.files import has_checksum, note_without_checksum, sealed_archive, write_bytes
from ganlane.generator.checkpoint import FitResult, Preset
from ganlane.generator.forecasts import Metrics
from ganlane.generator.segments import SceneTracks, scene_tracks
from ganlane.generator.tasks import CalibratedTask, PaperTask
from ganlane.generator.windows import content_hash, count_windows
from ganlane.parameters.generator import CalibratedConfig, LoopConfig, PaperConfig

#: Scenes that are held out by default.
HELD_OUT = ("us101-b", "us101-e", "us101-h", "us101-i")
#: Least share of the remaining windows that the validation scenes hold.
VALIDATION_SHARE = 1 / 12
Config = PaperConfig | CalibratedConfig
Task = PaperTask | CalibratedTask
_CONFIGS: dict[str, type[Config]] = {"paper": PaperConfig, "calibrated": CalibratedConfig}


@dataclass(frozen=True)
class Progress:
    """State of a fit after ``update`` of at most ``updates``, ``seconds`` after the start of this run.

    ``losses`` are the last update's; ``score`` is the last evaluation's (lower is better), ``best`` the lowest.
    """

    update: int
    updates: int
    losses: dict[str, float]
    score: float | None
    best: float
    seconds: float


OnProgress = Callable[[Progress], None]


class FitLoop:
    """Runs a task until it stops improving.

    ``resume_path`` keeps the state after every evaluation; the fit resumes from it if it exists. ``seconds`` is the
    time that the updates took, in earlier runs of the same fit too.
    """

    def __init__(self, task: Task, resume_path: str | Path | None = None):
        self.task, self.config = task, task.config.loop
        self.path = None if resume_path is None else Path(resume_path)
        self.done, self.waited, self.best_update, self.best = 0, 0, 0, math.inf
        self.seconds = 0.0
        self.best_weights: dict[str, dict[str, Tensor]] = {}
        if self.path is not None and self.path.exists():
            self._resume(self.path)

    def run(self, on_progress: OnProgress | None = None) -> None:
        """Fit, then put the best weights into the task's networks."""
        begun, earlier, score = time.monotonic(), self.seconds, None
        while self.done < self.config.updates and self.waited < self.config.patience:
            for optimiser in self.task.optimisers.values():
                optimiser.param_groups[0]["lr"] = learning_rate(self.config, self.done)
            losses = self.task.update(self.done)
            self.done += 1
            seconds = time.monotonic() - begun
            self.seconds = earlier + seconds
            late = self.config.max_seconds is not None and seconds > self.config.max_seconds
            if self.done % self.config.evaluate_every == 0 or self.done == self.config.updates or late:
                score = self._evaluate()
            if on_progress is not None:
                on_progress(Progress(self.done, self.config.updates, losses, score, self.best, seconds))
            if late:
                break
        for name, weights in self.best_weights.items():
            self.task.modules[name].load_state_dict(weights)

    def _evaluate(self) -> float:
        score = self.task.evaluate()
        self.waited += 1
        if score < self.best:
            self.best, self.best_update, self.waited = score, self.done, 0
            self.best_weights = {name: deepcopy(module.state_dict()) for name, module in self.task.modules.items()}
        if self.path is not None:
            file = io.BytesIO()
            torch.save(self._state(), file)
            write_bytes(self.path, sealed_archive(file.getvalue()))
        return score

    def _state(self) -> dict[str, Any]:
        """Counters, weights, optimisers and the random generator: tensors and plain data."""
        return {
            "counters": [self.done, self.waited, self.best_update],
            "best": self.best,
            "seconds": self.seconds,
            "best_weights": self.best_weights,
            "modules": {name: module.state_dict() for name, module in self.task.modules.items()},
            "optimisers": {name: optimiser.state_dict() for name, optimiser in self.task.optimisers.items()},
            "random": self.task.random.get_state(),
        }

    def _resume(self, path: Path) -> None:
        """Continue from a stored state; reading it never executes code."""
        content = path.read_bytes()
        whole = has_checksum(content, path)
        try:
            state = torch.load(io.BytesIO(content), weights_only=True)
            if "counters" not in state:
                raise ValueError("no counters")
        except Exception as error:
            raise UserError(
                f"{path}: not the state of a fit; give the file that a fit keeps, or remove it."
            ) from error
        try:
            for name, module in self.task.modules.items():
                module.load_state_dict(state["modules"][name])
            for name, optimiser in self.task.optimisers.items():
                optimiser.load_state_dict(state["optimisers"][name])
        except (KeyError, RuntimeError, ValueError) as error:
            raise UserError(
                f"{path}: holds another fit than the one asked for; give the same preset and sizes or remove it."
            ) from error
        self.done, self.waited, self.best_update = state["counters"]
        self.best, self.best_weights = state["best"], state["best_weights"]
        self.seconds = state["seconds"]
        self.task.random.set_state(state["random"])
        if not whole:
            note_without_checksum(path)


def learning_rate(config: LoopConfig, number: int) -> float:
    """Linear warm-up, then a half cosine to 0."""
    rise = min(1.0, (number + 1) / max(1, config.warmup))
    return config.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * number / config.updates))


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
    """Fit a generator to recorded trajectories in ``ganlane.data``'s schema.

    The weights are those that were best on the validation scenes, a small part of the scenes that are not held out
    (:func:`split_for_fit`). The metrics are theirs on the held-out scenes, which influence neither the weights nor
    early stopping. The driving statistics are of all scenes.

    Args:
        preset: ``"paper"`` (positions only, open loop) or ``"calibrated"`` (anchored, closed-loop rollouts).
        held_out: names of the scenes that are reported, used for neither fitting nor early stopping.
        config: of this preset; its defaults if None.
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
    loop: FitLoop, split: Split, frame: pl.DataFrame, source: str, metrics: Metrics, others: pl.DataFrame
) -> FitResult:
    """The result of a finished ``loop``; ``others`` are the recordings of the driving statistics."""
    task = loop.task
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
        statistics=driving_statistics(others).to_dict(),
        updates=loop.best_update,
        seconds=loop.seconds,
    )
