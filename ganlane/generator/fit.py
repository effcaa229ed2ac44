"""Fitting a preset to recordings: from trajectories to weights and errors on held-out scenes."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import polars as pl

from ganlane.data import driving_statistics, scene_lane_widths
from ganlane.errors import UserError
from ganlane.generator.checkpoint import FitResult, Preset
from ganlane.generator.fit_calibrated import CalibratedTask
from ganlane.generator.fit_paper import PaperTask
from ganlane.generator.groups import content_hash
from ganlane.generator.loop import FitLoop, OnProgress
from ganlane.generator.scores import Metrics
from ganlane.generator.splits import Split, split_for_fit
from ganlane.generator.windows import scene_tracks
from ganlane.parameters.generator import CalibratedConfig, PaperConfig

#: Scenes that are held out by default.
HELD_OUT = ("us101-b", "us101-e", "us101-h", "us101-i")
Config = PaperConfig | CalibratedConfig
Task = PaperTask | CalibratedTask
_CONFIGS: dict[str, type[PaperConfig] | type[CalibratedConfig]] = {
    "paper": PaperConfig,
    "calibrated": CalibratedConfig,
}


def preset_of(config: Config) -> Preset:
    """The preset that a config belongs to."""
    return "paper" if isinstance(config, PaperConfig) else "calibrated"


def fit_task(config: Config, split: Split, widths: dict[str, float]) -> Task:
    """The task on the fitted and validation scenes of ``split``; ``widths`` are the scenes' lane widths, m."""
    if isinstance(config, PaperConfig):
        return PaperTask(split.fitted, split.validation, config)
    return CalibratedTask(split.fitted, split.validation, widths, config)


def fit_key(config: Config, split: Split) -> str:
    """Hash of everything that a fit depends on: its settings, and the recordings of each part of the split."""
    settings = {"preset": preset_of(config), "config": json.loads(json.dumps(asdict(config))), **split.names}
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
    (:func:`ganlane.generator.splits.split_for_fit`). The metrics are theirs on the held-out scenes, which influence
    neither the weights nor early stopping. The driving statistics are of all scenes.

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
    split, widths = split_for_fit(scene_tracks(frame), held_out), scene_lane_widths(frame)
    task = fit_task(config, split, widths)
    loop = FitLoop(task, config.loop, resume_path)
    loop.run(on_progress)
    metrics = task.metrics(split.held_out)
    if isinstance(task, PaperTask):
        metrics["discriminator"] = {"held_out_accuracy": task.discriminator_accuracy(split.held_out)}
    return fit_result(task, loop, split, frame, widths, source, metrics)


def fit_result(
    task: Task,
    loop: FitLoop,
    split: Split,
    frame: pl.DataFrame,
    widths: dict[str, float],
    source: str,
    metrics: Metrics,
    statistics_of: pl.DataFrame | None = None,
) -> FitResult:
    """The result of a finished ``loop``; ``statistics_of`` are the recordings of the driving statistics, else all."""
    return FitResult(
        preset=preset_of(task.config),
        module=task.generator.eval().requires_grad_(False),
        metrics=metrics,
        config=asdict(task.config),
        data={
            "file": Path(source).name,
            "rows": frame.height,
            "tracks": frame.select(pl.struct("scene", "vehicle").n_unique()).item(),
            **split.names,
        },
        statistics=driving_statistics(frame if statistics_of is None else statistics_of, widths).to_dict(),
        updates=loop.best_update,
        seconds=loop.seconds,
    )
