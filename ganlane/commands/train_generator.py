"""Fit a generator to recordings and measure it on scenes that it was not fitted to."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ganlane import generator
from ganlane.settings.recordings import TrainGeneratorConfig
from ganlane.data import byte_progress, read_recordings, recordings_path
from ganlane.evaluation import code_version, write_results
from ganlane.evaluation.table import aligned, show
from ganlane.generator import FitResult, Progress
from ganlane.torch_settings import set_threads

_ERRORS = ("ade_m", "fde_m", "end_m")
_BASELINE = "constant_velocity"
_PUBLISHED_VELOCITY_M = (0.73, 1.78, 3.13, 4.78, 6.68)
#: RMSE in m after 1 to 5 s on NGSIM, as published: on other test sets than ours, so only roughly
#: comparable.
_PUBLISHED_RMSE_M = {
    "constant velocity (published)": _PUBLISHED_VELOCITY_M,
    "CS-LSTM (published)": (0.61, 1.27, 2.09, 3.10, 4.37),
    "Social-GAN (published)": (0.57, 1.32, 2.22, 3.26, 4.40),
}

#: Headings and rows of a table.
Lines = list[list[str]]


def train_generator(config: TrainGeneratorConfig, folder: Path) -> str:
    """Read the recordings, fit, print the errors on held-out scenes, save weights and results."""
    set_threads(config.threads)
    source = recordings_path(config.data)
    with byte_progress("read") as read:
        frame = read_recordings(config.data.format, source, config.data.parameters(), read)
    fit_config: Any = replace(config.generator, seed=config.seed)
    preset = fit_config.preset
    scenes = generator.scene_tracks(frame)
    held_out = config.data.held_out_scenes([scene.name for scene in scenes], generator.HELD_OUT)
    split = generator.split_for_fit(scenes, held_out)
    if config.folds:
        # too many are refused now rather than after hours of ablations
        generator.assign_folds(scenes, config.folds)
    states = Path(config.resume or folder) / "fits"
    further: dict[str, Any] = {}
    if config.ablations:
        with FitProgress() as progress:
            further["ablations"] = generator.ablate(
                frame, fit_config, held_out, states, progress.next_fit, progress
            )
        show(ablation_table(further["ablations"]), columns=config.columns)
    if config.folds:

        def save(number: int, fold: FitResult) -> None:
            fold.save(folder / f"generator_{preset}_fold_{number}.safetensors", code=code_version())

        with FitProgress() as progress:
            further["folds"] = generator.cross_validate(
                frame,
                fit_config,
                config.folds,
                states,
                progress.next_fit,
                progress,
                save,
                source=str(source),
            )
        show(fold_tables(further["folds"]), columns=config.columns)
    with FitProgress() as progress:
        result = generator.fit_generator(
            preset,
            frame,
            held_out=held_out,
            config=fit_config,
            source=str(source),
            resume_path=states / f"generator_{generator.fit_key(fit_config, split)}.pt",
            on_progress=progress,
        )
    show(metrics_table(result.metrics), columns=config.columns)
    weights = folder / f"generator_{preset}.safetensors"
    result.save(weights, further.get("folds"), code_version())
    print(f"weights: {weights}")
    numbers = results_of(result) | further | {"weights": str(weights)}
    context = {"seed": config.seed, "held_out": held_out}
    used = asdict(replace(config, generator=fit_config))
    return f"results: {write_results(folder, numbers, used, context)}"


class FitProgress(AbstractContextManager["FitProgress"]):
    """Shows a fit: a bar on a terminal, else a line per improvement and a last one.

    A context that closes the bar.
    """

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._best = math.inf

    def next_fit(self, name: str) -> None:
        """Start the display of another fit."""
        self.__exit__()
        self._bar, self._best = None, math.inf
        print(name, file=sys.stderr, flush=True)

    def __call__(self, progress: Progress) -> None:
        """Called by the fit after every update."""
        update, updates = progress.update, progress.updates
        scores = (
            ""
            if progress.score is None
            else f"validation score {progress.score:.4f}, best {progress.best:.4f}"
        )
        if sys.stderr.isatty():
            if self._bar is None:
                self._bar = tqdm(total=updates, desc="fit", unit="update", file=sys.stderr)
            self._bar.update(update - self._bar.n)
            if scores:
                self._bar.set_postfix_str(scores)
        elif progress.best < self._best or update == updates:
            self._best = progress.best
            left_s = progress.seconds / update * (updates - update)
            parts = [
                f"{update} of {updates} updates",
                f"at most {left_s:.0f} s left",
                *([scores] if scores else []),
            ]
            print(", ".join(parts), file=sys.stderr, flush=True)

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()


def _by_kind(measured: Mapping[str, float]) -> dict[str, Any]:
    """``{"ade_m/mean": x, ..., "windows": n}`` as ``{"ade_m": {"mean": x, ...}, ..., "windows".

    N}``.
    """
    nested: dict[str, Any] = {}
    for name, value in measured.items():
        error, _, kind = name.partition("/")
        if kind:
            nested.setdefault(error, {})[kind] = value
        else:
            nested[name] = value
    return nested


def results_of(result: FitResult) -> dict[str, Any]:
    """The numbers of ``results.json``: errors over all held-out scenes, and per scene."""
    scenes = {
        name: _by_kind(values)
        for name, values in result.metrics.items()
        if name in result.data["held_out"]
    }
    other = {
        name: dict(values)
        for name, values in result.metrics.items()
        if name != "all" and name not in scenes
    }
    return {
        "preset": result.preset,
        **_by_kind(result.metrics["all"]),
        "scenes": scenes,
        **other,
        "data": result.data,
        "statistics": result.statistics,
        "updates": result.updates,
        "wall_s": result.seconds,
    }


def _percent(change: float) -> str:
    return f"{change:+.1f} %"


def metrics_table(metrics: Mapping[str, Mapping[str, float]]) -> str:
    """ADE and FDE of the generator and of constant velocity on the held-out scenes, as text."""
    overall = _by_kind(metrics["all"])
    errors = [error for error in _ERRORS if error in overall]
    lines = [["held-out scenes", *(error.replace("_m", ", m") for error in errors), "ADE to CV"]]
    for kind, ade in overall["ade_m"].items():
        change = _percent(100.0 * (ade / overall["ade_m"][_BASELINE] - 1.0))
        lines.append(
            [kind, *(f"{overall[error].get(kind, math.nan):.3f}" for error in errors), change]
        )
    return aligned(lines)


def ablation_table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The ablations as text.

    Change of ADE over all predicted steps and over 0.4 s, ratio of the RMSE at 5 s.
    """
    first = next(iter(rows.values()))
    kinds = [kind for kind in first["ade_change_percent"] if kind != _BASELINE]
    at_5_s = ["RMSE 5 s"] if "rmse_5_s_ratio" in first else []
    lines = [
        [
            "ADE to CV, a quarter of the updates",
            *kinds,
            *(f"{kind}, 0.4 s" for kind in kinds),
            *at_5_s,
        ]
    ]
    for name, row in rows.items():
        parts = (row["ade_change_percent"], row["ade_change_percent_0.4_s"])
        ratio = [f"{row['rmse_5_s_ratio']['mean']:.2f}"] if at_5_s else []
        lines.append([name, *(_percent(part[kind]) for part in parts for kind in kinds), *ratio])
    return aligned(lines)


def fold_tables(folds: Mapping[str, Any]) -> str:
    """All tables of :func:`ganlane.generator.cross_validate`'s result, as text."""
    scores = folds["open_loop"]
    titles = {"folds": "by fold", "scenes": "by scene", "parts": "by lane (1 leftmost) and class"}
    tables = [
        _pooled(scores),
        *(_rows(title, scores[name]) for name, title in titles.items()),
        _direction(scores),
    ]
    if "rollout" in folds:
        tables.append(_rollout(folds["rollout"]))
    return "\n\n".join(map(aligned, tables))


def _pooled(scores: Mapping[str, Any]) -> Lines:
    """ADE and FDE of all forecasts over the windows of all folds."""
    lines = [[f"{scores['windows']} windows of all folds", "ADE, m", "FDE, m", "ADE to CV"]]
    for kind, ade in scores["ade_m"].items():
        change = _percent(scores["ade_change_percent"][kind])
        lines.append([kind, f"{ade:.3f}", f"{scores['fde_m'][kind]:.3f}", change])
    return lines


def _rows(title: str, rows: Mapping[str, Any]) -> Lines:
    """Windows, constant velocity's ADE and the generator's change relative to it, for every row."""
    first = next(iter(rows.values()))
    kinds = [
        kind for kind in first["ade_m"] if kind in ("mean", "single") or kind.startswith("best_of")
    ]
    lines = [[title, "windows", "CV, m", *kinds]]
    for name, row in rows.items():
        changes = [_percent(row["ade_change_percent"][kind]) for kind in kinds]
        lines.append([name, str(row["windows"]), f"{row['ade_m'][_BASELINE]:.3f}", *changes])
    return lines


def _direction(scores: Mapping[str, Any]) -> Lines:
    """Share of lateral moves of more than 0.1 m whose side is predicted correctly."""
    later, whole = scores["direction"], scores["direction_whole_window"]
    lines = [
        ["lateral move to the right side", "after present", "whole window"],
        ["windows that move", str(later["windows"]), str(whole["windows"])],
    ]
    for kind, share in later["share_right"].items():
        shares = (share, whole["share_right"].get(kind))
        lines.append([kind, *("" if value is None else f"{100 * value:.1f} %" for value in shares)])
    return lines


def _rollout(rollout: Mapping[str, Any]) -> Lines:
    """RMSE after 1 to 5 s, with published values."""
    rmse = {kind: list(values.values()) for kind, values in rollout["rmse_m"].items()}
    ratios = dict(rollout["ratio_to_constant_velocity"])
    for kind, published in _PUBLISHED_RMSE_M.items():
        rmse[kind], ratios[kind] = list(published), published[-1] / _PUBLISHED_VELOCITY_M[-1]
    seconds = next(iter(rollout["rmse_m"].values()))
    lines = [[f"RMSE, m ({rollout['windows']} windows)", *seconds, "to CV"]]
    lines += [
        [kind, *(f"{value:.2f}" for value in values), f"{ratios[kind]:.2f}"]
        for kind, values in rmse.items()
    ]
    return lines
