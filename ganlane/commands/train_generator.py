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
from ganlane.data import (
    byte_progress,
    read_recordings,
    recordings_path,
)
from ganlane.data.dense import Recording, recordings_of
from ganlane.data.one_lane import one_lane_files, read_one_lane
from ganlane.evaluation import code_version, write_results
from ganlane.evaluation.table import aligned, show
from ganlane.generator import FitResult, Progress
from ganlane.generator.forecasts import BASELINE, SAMPLES
from ganlane.generator.human_estimator import HumanModel
from ganlane.settings.generator import HumanConfig
from ganlane.settings.recordings import TrainGeneratorConfig
from ganlane.torch_settings import set_threads

# Average and final displacement error, and the error at the window's end, m.
_ERRORS = ("ade_m", "fde_m", "end_m")

#: Headings and rows of a table.
Lines = list[list[str]]


def train_generator(config: TrainGeneratorConfig, folder: Path) -> str:
    """Read the recordings, fit, print the errors on held-out scenes, save weights and results."""
    set_threads(config.threads)
    source = recordings_path(config.data)
    with byte_progress("read") as read:
        frame = read_recordings(
            config.data.format,
            source,
            config.data.parameters(),
            read,
        )
    # The seed of the command is that of the fit.
    fit_config: Any = replace(config.generator, seed=config.seed)
    scenes = recordings_of(frame)
    held_out = config.data.held_out_scenes([scene.name for scene in scenes], generator.HELD_OUT)
    # Scenes that do not fit together are refused now rather than after hours of fitting.
    generator.split_for_fit(scenes, held_out)
    if config.folds:
        generator.assign_folds(scenes, config.folds)

    sites = sites_beside(source) if isinstance(fit_config, HumanConfig) else {}
    following = [recording for recordings in sites.values() for recording in recordings]
    # A resumed command finds its finished fits here and does not repeat them.
    states = Path(config.resume or folder) / "fits"
    weights = folder / f"generator_{fit_config.preset}.safetensors"
    further: dict[str, Any] = {}
    # What takes long is shown as soon as it is there; the last fit is the one that is saved.
    with FitProgress() as progress:
        if config.folds:
            further["folds"], results = generator.cross_validate(
                fit_config,
                frame,
                config.folds,
                states,
                progress,
                str(source),
                following,
            )
            # A realism card by folds drives every scene by the generator that never saw it.
            for number, fold in enumerate(results, start=1):
                path = weights.with_stem(f"{weights.stem}_fold_{number}")
                fold.save(path, code=code_version())
            show(
                fold_tables(further["folds"]),
                columns=config.columns,
            )
        # The generator that is saved is fitted to everything but the held-out scenes.
        result = generator.fit_generator(
            fit_config,
            frame,
            held_out,
            states,
            progress,
            str(source),
            following,
        )

    show(metrics_table(result.metrics), columns=config.columns)
    if isinstance(result.module, HumanModel) and sites and not fit_config.following:
        further["sites"] = generator.site_scores(result.module, sites)
        show(aligned(site_table(further["sites"])), columns=config.columns)
    result.save(weights, further.get("folds"), code_version())
    print(f"weights: {weights}")
    # What the command line shows is also in results.json, in full.
    numbers = results_of(result) | further | {"weights": str(weights)}
    context = {"seed": config.seed, "held_out": held_out}
    used = asdict(replace(config, generator=fit_config))
    return f"results: {write_results(folder, numbers, used, context)}"


def sites_beside(scenes: Path) -> dict[str, list[Recording]]:
    """Cars that follow each other in one lane, from the files beside ``scenes``; perhaps none."""
    return {name: read_one_lane(name, file) for name, file in one_lane_files(scenes).items()}


def site_table(scores: Mapping[str, Mapping[str, float]]) -> Lines:
    """What :func:`ganlane.generator.site_scores` found: a column per site."""
    names = next(iter(scores.values()))
    lines = [["at other sites; errors to CV", *scores]]
    for name in names:
        digits = 0 if name.startswith("windows") else 2
        lines.append([name, *(f"{row[name]:.{digits}f}" for row in scores.values())])
    return lines


class FitProgress(AbstractContextManager["FitProgress"]):
    """Shows fits, one after the other: a bar on a terminal, else a line per improvement.

    A context that closes the last bar.
    """

    def __init__(self) -> None:
        self._name = ""
        self._bar: tqdm | None = None
        self._best = math.inf

    def __call__(self, progress: Progress) -> None:
        """Called by the fit after every update."""
        if progress.name != self._name:
            self._start(progress)
        update = progress.update
        updates = progress.updates
        scores = ""
        if progress.score is not None:
            scores = f"validation score {progress.score:.4f}, best {progress.best:.4f}"
        if self._bar is not None:
            self._bar.update(update - self._bar.n)
            self._bar.set_postfix_str(scores, refresh=False)
        # On no terminal a line per improvement is enough; logs would grow without end.
        elif progress.best < self._best or update == updates:
            self._best = progress.best
            # Early stopping may end the fit sooner.
            left_s = progress.seconds / update * (updates - update)
            parts = [
                f"{update} of {updates} updates",
                f"at most {left_s:.0f} s left",
                scores,
            ]
            print(
                ", ".join(filter(None, parts)),
                file=sys.stderr,
                flush=True,
            )

    def _start(self, progress: Progress) -> None:
        """The first update of another fit."""
        # Closes the bar of the fit before, if there was one.
        self.__exit__()
        self._name = progress.name
        self._best = math.inf
        if sys.stderr.isatty():
            self._bar = tqdm(
                total=progress.updates,
                desc=progress.name,
                unit="update",
            )
        else:
            print(progress.name, file=sys.stderr, flush=True)

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()


def _by_kind(measured: Mapping[str, float]) -> dict[str, Any]:
    """``{"ade_m/mean": x, "windows": n}`` as ``{"ade_m": {"mean": x}, "windows": n}``."""
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
    # A copy: parts are taken out below, and the result keeps its own.
    metrics = dict(result.metrics)
    overall = _by_kind(metrics.pop("all"))
    # Held-out scenes without windows have no errors.
    scenes = {
        name: _by_kind(metrics.pop(name)) for name in result.data["held_out"] if name in metrics
    }
    return {
        "preset": result.config.preset,
        **overall,
        "scenes": scenes,
        # What is no scene: the discriminator of the paper's preset.
        **metrics,
        "data": result.data,
        "statistics": result.statistics,
        "updates": result.updates,
        "wall_s": result.seconds,
    }


def _percent(change: float) -> str:
    return f"{change:+.1f} %"


def metrics_table(
    metrics: Mapping[str, Mapping[str, float]],
) -> str:
    """ADE and FDE of the generator and of constant velocity on the held-out scenes, as text."""
    overall = _by_kind(metrics["all"])
    errors = [error for error in _ERRORS if error in overall]
    lines = [
        [
            "held-out scenes",
            *(error.replace("_m", ", m") for error in errors),
            "ADE to CV",
        ]
    ]
    for kind, ade in overall["ade_m"].items():
        cells = [f"{overall[error].get(kind, math.nan):.3f}" for error in errors]
        # ADE relative to constant velocity, the baseline that any model has to beat.
        change = 100.0 * (ade / overall["ade_m"][BASELINE] - 1.0)
        lines.append([kind, *cells, _percent(change)])
    return aligned(lines)


def fold_tables(folds: Mapping[str, Any]) -> str:
    """What :func:`ganlane.generator.cross_validate` scored, but for single scenes, as text."""
    scores = folds["open_loop"]
    tables = [_pooled(scores), _parts("by fold", scores["folds"])]
    if "rollout" in folds:
        tables.append(_rollout(folds["rollout"]))
    return "\n\n".join(map(aligned, tables))


def _pooled(scores: Mapping[str, Any]) -> Lines:
    """ADE and FDE of all forecasts over the windows of all folds."""
    lines = [
        [
            f"{scores['windows']} windows of all folds",
            "ADE, m",
            "FDE, m",
            "ADE to CV",
        ]
    ]
    for kind, ade in scores["ade_m"].items():
        errors = [f"{ade:.3f}", f"{scores['fde_m'][kind]:.3f}"]
        lines.append([kind, *errors, _percent(scores["ade_change_percent"][kind])])
    return lines


def _parts(title: str, parts: Mapping[str, Any]) -> Lines:
    """Windows, constant velocity's ADE and the generator's change relative to it, for each part."""
    # The mean of the samples, one sample, and the best of several: different questions.
    generated = ("mean", "single", f"best_of_{SAMPLES}")
    kinds = [kind for kind in generated if kind in next(iter(parts.values()))["ade_m"]]
    lines = [[title, "windows", "CV, m", *kinds]]
    for name, part in parts.items():
        changes = [_percent(part["ade_change_percent"][kind]) for kind in kinds]
        lines.append(
            [
                name,
                str(part["windows"]),
                f"{part['ade_m'][BASELINE]:.3f}",
                *changes,
            ]
        )
    return lines


def _rollout(rollout: Mapping[str, Any]) -> Lines:
    """RMSE after 1 to 5 s."""
    rmse = rollout["rmse_m"]
    lines = [
        [
            f"RMSE, m ({rollout['windows']} windows)",
            *rmse[BASELINE],
            "to CV",
        ]
    ]
    for kind, ratio in rollout["ratio_to_constant_velocity"].items():
        numbers = [*rmse[kind].values(), ratio]
        lines.append([kind, *(f"{number:.2f}" for number in numbers)])
    return lines
