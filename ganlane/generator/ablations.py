"""What each part of a preset is worth: the same fit at a quarter of the budget, with one part changed at a time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ganlane.data import scene_lane_widths
from ganlane.generator.calibrated import CalibratedConfig
from ganlane.generator.cross_validation import OnFit
from ganlane.generator.fitting import PaperConfig
from ganlane.generator.folds import split_for_fit
from ganlane.generator.loop import OnProgress
from ganlane.generator.reports import Fitted, fit_and_report, rollout_scores
from ganlane.generator.schedule import LoopConfig
from ganlane.generator.scores import BASELINE, displacement_errors, errors_of
from ganlane.generator.tracks import scene_tracks

#: Part of the updates that an ablation has.
BUDGET = 4
#: History noise that is tried, in units of a typical difference.
_NOISE = 0.5
#: Steps at which predictions of any length can be compared (0.4 s).
_COMMON_STEPS = 4
Config = PaperConfig | CalibratedConfig


def shortened(loop: LoopConfig) -> LoopConfig:
    """The same loop with a quarter of the updates."""
    parts = {name: max(1, getattr(loop, name) // BUDGET) for name in ("updates", "evaluate_every", "warmup")}
    return replace(loop, **parts)


def variants(config: Config) -> dict[str, Config]:
    """Name to settings; the first is the preset itself."""
    config = replace(config, loop=shortened(config.loop))
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
        "variety term alone": replace(config, weights=replace(weights, single=0.0, mean=0.0, adversarial=0.0)),
        f"with history noise of {_NOISE}": replace(config, history_noise=_NOISE),
    }


def ablate(
    preset: str,
    frame: pl.DataFrame,
    config: Config,
    held_out: tuple[str, ...],
    folder: Path,
    on_fit: OnFit | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, dict[str, Any]]:
    """Fit every variant to one split and score it on ``held_out``; goes on with what ``folder`` holds.

    Returns:
        Per variant ``windows``, the change of ADE to repeating the last displacement in % (``ade_change_percent``) by
        kind, over all predicted steps and over the first 0.4 s (``ade_change_percent_0.4_s``), and for the
        calibrated preset ``rmse_5_s_ratio``, the RMSE after 5 s over constant velocity's.
    """
    split, widths = split_for_fit(scene_tracks(frame), held_out), scene_lane_widths(frame)
    rows = {}
    for name, variant in variants(config).items():
        if on_fit is not None:
            on_fit(name)
        rows[name] = _row(fit_and_report(preset, variant, split, widths, folder, on_progress))
    return rows


def _row(fit: Fitted) -> dict[str, Any]:
    errors = errors_of(fit.near.forecasts, fit.near.windows.future)
    kinds = [kind for kind in errors if kind in ("mean", "single") or kind.startswith("best_of")]
    chosen = {kind: errors[kind] for kind in (*kinds, BASELINE)}
    early: Mapping[str, np.ndarray] = {kind: values[:, :_COMMON_STEPS] for kind, values in chosen.items()}
    whole, part = displacement_errors(chosen), displacement_errors(dict(early))
    row = {"windows": whole["windows"], "ade_change_percent": whole["ade_change_percent"]}
    row["ade_change_percent_0.4_s"] = part["ade_change_percent"]
    if fit.far is not None:
        ratio = rollout_scores(fit.far.windows, fit.far.forecasts)["ratio_to_constant_velocity"]
        row["rmse_5_s_ratio"] = {kind: ratio[kind] for kind in ("mean", "single")}
    return row


def ablation_table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The rows as text: changes of ADE over all predicted steps, then over the first 0.4 s, then the ratio at 5 s."""
    first = next(iter(rows.values()))
    kinds = [kind for kind in first["ade_change_percent"] if kind != BASELINE]
    heads = [*kinds, *(f"{kind}, 0.4 s" for kind in kinds), *(["RMSE 5 s"] if "rmse_5_s_ratio" in first else [])]
    lines = [f"{'ADE to CV, a quarter of the updates':<36}" + "".join(f"{head:>18}" for head in heads)]
    for name, row in rows.items():
        parts = (row["ade_change_percent"], row["ade_change_percent_0.4_s"])
        cells = [f"{part[kind]:+.1f} %" for part in parts for kind in kinds]
        cells += [f"{row['rmse_5_s_ratio']['mean']:.2f}"] if "rmse_5_s_ratio" in row else []
        lines.append(f"{name:<36}" + "".join(f"{cell:>18}" for cell in cells))
    return "\n".join(lines)
