"""k folds by scene: every scene is forecast by a generator that never saw it, and all windows are scored together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import polars as pl

from ganlane.data import driving_statistics, scene_lane_widths
from ganlane.generator.calibrated import CalibratedConfig
from ganlane.generator.checkpoint import Preset
from ganlane.generator.fit import FitResult, describe
from ganlane.generator.fitting import PaperConfig
from ganlane.generator.folds import Split, assign_folds, split_for_fit
from ganlane.generator.loop import OnProgress
from ganlane.generator.reports import Fitted, fit_and_report, pooled, rollout_scores
from ganlane.generator.scores import open_loop_scores
from ganlane.generator.tracks import scene_tracks

#: Told what is fitted next.
OnFit = Callable[[str], None]
#: Given each fold's number, from 1 on, and its generator.
OnFold = Callable[[int, FitResult], None]


def cross_validate(
    preset: Preset,
    frame: pl.DataFrame,
    config: PaperConfig | CalibratedConfig,
    folds: int,
    folder: Path,
    on_fit: OnFit | None = None,
    on_progress: OnProgress | None = None,
    on_fold: OnFold | None = None,
    source: str = "",
) -> dict[str, Any]:
    """Fit ``folds`` generators, each without its fold's scenes, and score them on these.

    Within a fold a part of the other scenes chooses when to stop. Called again with the same ``folder`` it goes on
    where it was stopped. ``on_fold`` is given each fold's generator, with driving statistics of its other scenes:
    the fold's own have no say in it. ``source`` names the recordings in its metadata.

    Returns:
        ``open_loop`` (:func:`ganlane.generator.scores.open_loop_scores`), ``splits`` (names of the scenes of each
        fold's parts), and for the calibrated preset ``rollout`` (:func:`ganlane.generator.reports.rollout_scores`).

    Raises:
        UserError: too many folds for the recordings.
    """
    scenes, widths = scene_tracks(frame), scene_lane_widths(frame)
    splits = [split_for_fit(scenes, names) for names in assign_folds(scenes, folds)]
    fits: list[Fitted] = []
    for number, split in enumerate(splits, start=1):
        if on_fit is not None:
            on_fit(f"fold {number} of {folds}")
        fits.append(fit_and_report(preset, config, split, widths, folder, on_progress))
        if on_fold is not None:
            on_fold(number, _fold_result(preset, config, fits[-1], split, frame, widths, source))
    scores: dict[str, Any] = {
        "splits": [split.names for split in splits],
        "open_loop": open_loop_scores(*pooled([fit.near for fit in fits])),
    }
    far = [fit.far for fit in fits if fit.far is not None]
    if far:
        scores["rollout"] = rollout_scores(*pooled(far)[:2])
    return scores


def _fold_result(
    preset: Preset,
    config: PaperConfig | CalibratedConfig,
    fitted: Fitted,
    split: Split,
    frame: pl.DataFrame,
    widths: dict[str, float],
    source: str,
) -> FitResult:
    """A fold's generator, described as one that is fitted by itself."""
    others = frame.filter(~pl.col("scene").is_in(split.names["held_out"]))
    return FitResult(
        preset=preset,
        module=fitted.generator,
        metrics={},
        config=asdict(config),
        data=describe(source, frame, split),
        statistics=driving_statistics(others, widths).to_dict(),
        updates=fitted.updates,
        seconds=fitted.seconds,
    )
