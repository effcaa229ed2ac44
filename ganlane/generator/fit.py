"""One call that fits a preset to recordings: data in, weights and held-out metrics out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import polars as pl

from ganlane.data import driving_statistics, scene_lane_widths
from ganlane.errors import UserError
from ganlane.generator.calibrated import CalibratedConfig, CalibratedTask
from ganlane.generator.checkpoint import Preset, save_generator
from ganlane.generator.fitting import PaperConfig, PaperTask
from ganlane.generator.folds import Split, split_for_fit
from ganlane.generator.loop import FitLoop, OnProgress
from ganlane.generator.metrics import Metrics
from ganlane.generator.networks import Generator
from ganlane.generator.tracks import scene_tracks

#: Scenes that are not fitted to unless told otherwise.
HELD_OUT = ("us101-b", "us101-e", "us101-h", "us101-i")


@dataclass(frozen=True)
class FitResult:
    """What a fit gives.

    Attributes:
        preset: ``"paper"`` or ``"calibrated"``.
        module: the generator with the weights that did best on the validation scenes.
        metrics: of these weights on the held-out scenes, for ``"all"`` and each scene; the paper's preset also
            has ``"discriminator": {"held_out_accuracy"}``. Empty for a fold's, which are scored together.
        config: what it was fitted with, as plain data.
        data: scenes fitted, of validation and held out, vehicles and rows.
        statistics: of all recordings, held out or not (``DrivingStatistics.to_dict()``); a fold's are of its other
            scenes.
        updates: updates after which the weights were taken (early stopping).
        seconds: time of the fit, with its evaluations on the validation scenes.
    """

    preset: Preset
    module: Generator
    metrics: Metrics
    config: dict[str, Any]
    data: dict[str, Any]
    statistics: dict[str, Any]
    updates: int
    seconds: float

    def save(
        self, path: str | Path, folds: Mapping[str, Any] | None = None, code: Mapping[str, Any] | None = None
    ) -> None:
        """Write weights and metadata (:func:`ganlane.generator.checkpoint.save_generator`)."""
        save_generator(
            path,
            self.module,
            self.preset,
            config=self.config,
            data=self.data,
            metrics={**self.metrics, "fit": {"updates": self.updates, "seconds": round(self.seconds, 1)}},
            driving_statistics=self.statistics,
            folds=folds,
            code=code,
        )


def fit_generator(
    preset: Preset,
    frame: pl.DataFrame,
    *,
    held_out: tuple[str, ...] = HELD_OUT,
    config: PaperConfig | CalibratedConfig | None = None,
    source: str = "",
    resume_path: str | Path | None = None,
    on_progress: OnProgress | None = None,
) -> FitResult:
    """Fit a generator to recorded trajectories.

    The weights returned are those at the update at which they did best on the validation scenes, a small part of
    the scenes that are not held out (:func:`ganlane.generator.folds.split_for_fit`). The metrics are theirs on the
    held-out scenes, which had no say in the weights or in when to stop. The driving statistics are of all scenes.

    Args:
        preset: ``"paper"`` (positions only, open loop) or ``"calibrated"`` (anchored, closed-loop rollouts).
        frame: recordings in ``ganlane.data``'s schema.
        held_out: names of the scenes that are reported: neither fitted to nor used to choose when to stop.
        config: :class:`PaperConfig` or :class:`CalibratedConfig`, by preset; its defaults if None.
        source: name of the recordings, for the metadata.
        resume_path: file to keep the state in, and to go on from.
        on_progress: called after every update.

    Raises:
        UserError: unknown preset, a config of the other preset, unusable recordings or scene names.
    """
    split = split_for_fit(scene_tracks(frame), held_out)
    widths = scene_lane_widths(frame)
    task = fit_task(preset, split, widths, config)
    loop = FitLoop(task, task.config.loop, resume_path)
    loop.run(on_progress)
    metrics = task.metrics(split.held_out)
    if isinstance(task, PaperTask):
        metrics["discriminator"] = {"held_out_accuracy": task.discriminator_accuracy(split.held_out)}
    return FitResult(
        preset=preset,
        module=task.generator.eval().requires_grad_(False),
        metrics=metrics,
        config=asdict(task.config),
        data=describe(source, frame, split),
        statistics=driving_statistics(frame, widths).to_dict(),
        updates=loop.best_update,
        seconds=loop.seconds,
    )


def fit_task(
    preset: str, split: Split, widths: dict[str, float], config: PaperConfig | CalibratedConfig | None = None
) -> PaperTask | CalibratedTask:
    """The task of a preset on the first two parts of ``split``; ``widths`` are the scenes' lane widths, m.

    Raises:
        UserError: unknown preset, or a config of the other one.
    """
    kinds: dict[str, Callable[[], PaperConfig | CalibratedConfig]] = {
        "paper": PaperConfig,
        "calibrated": CalibratedConfig,
    }
    if preset not in kinds:
        raise UserError(f"preset {preset!r}: expected one of {sorted(kinds)}.")
    config = kinds[preset]() if config is None else config
    if isinstance(config, PaperConfig) and preset == "paper":
        return PaperTask(split.fitted, split.validation, config)
    if isinstance(config, CalibratedConfig) and preset == "calibrated":
        return CalibratedTask(split.fitted, split.validation, widths, config)
    raise UserError(
        f"config {type(config).__name__}: not the one of preset {preset!r}; give a {kinds[preset].__name__}."
    )


def describe(source: str, frame: pl.DataFrame, split: Split) -> dict[str, Any]:
    """The recordings ``frame`` of the file ``source``, and what each scene was for."""
    return {
        "file": Path(source).name,
        "rows": frame.height,
        "tracks": frame.select(pl.struct("scene", "vehicle").n_unique()).item(),
        **split.names,
    }
