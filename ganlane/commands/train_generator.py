"""Fit a generator to recordings and measure it on scenes that it was not fitted to."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ganlane import generator
from ganlane.data import byte_progress, read_recordings, recordings_path
from ganlane.data.dense import Recording, recordings_of
from ganlane.data.one_lane import one_lane_files, read_one_lane
from ganlane.evaluation import code_version, write_results
from ganlane.evaluation.table import aligned, show
from ganlane.generator import Progress
from ganlane.generator.forecasts import BASELINE, SAMPLES
from ganlane.settings.generator import HumanConfig
from ganlane.settings.recordings import TrainGeneratorConfig

#: Headings and rows of a table.
Lines = list[list[str]]


def train_generator(config: TrainGeneratorConfig, folder: Path) -> str:
    """Read the recordings, fit, print the errors on held-out scenes, save weights and results.

    Raises:
        UserError: recordings that cannot be read, or scenes that do not fit together.
    """
    source = recordings_path(config.data)
    with byte_progress("read") as read:
        frame = read_recordings(config.data.format, source, config.data.parameters(), read)
    scenes = recordings_of(frame)
    names = [scene.name for scene in scenes]
    held_out = config.data.held_out_scenes(names, generator.HELD_OUT)
    # The seed of the command is that of the fit.
    fit_config: Any = replace(config.generator, seed=config.seed)
    # Scenes that do not fit together are refused now rather than after hours of fitting.
    generator.split_for_fit(scenes, held_out)
    if config.folds:
        generator.assign_folds(scenes, config.folds)

    following: list[Recording] = []
    # Cars that follow each other in one lane, from the files beside the scenes; perhaps none.
    if isinstance(fit_config, HumanConfig):
        for name, file in one_lane_files(source).items():
            following += read_one_lane(name, file)
    # A resumed command finds its finished fits here and does not repeat them.
    states = Path(config.resume or folder) / "fits"
    weights = folder / f"generator_{fit_config.preset}.safetensors"
    further: dict[str, Any] = {}

    # What takes long is shown as soon as it is there; the last fit is the one that is saved.
    with FitProgress() as progress:
        if config.folds:
            further["folds"] = generator.cross_validate(
                fit_config,
                frame,
                config.folds,
                states,
                progress,
                following,
            )
            show(fold_tables(further["folds"]), columns=config.columns)
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

    # Errors of each held-out scene, and of all of them together.
    scenes_apart = dict(result.metrics)
    overall = scenes_apart.pop("all")
    show(aligned(errors_table(overall, "held out")), columns=config.columns)
    result.save(weights, further.get("folds"), code_version())
    print(f"weights: {weights}")

    # What the command line shows is also in results.json, in full.
    numbers = {
        "preset": result.config.preset,
        **overall,
        "scenes": scenes_apart,
        "data": result.data,
        "statistics": result.statistics,
        "updates": result.updates,
        "wall_s": result.seconds,
        **further,
        "weights": str(weights),
    }
    context = {"seed": config.seed, "held_out": held_out}
    used = replace(config, generator=fit_config)
    return f"results: {write_results(folder, numbers, used, context)}"


class FitProgress(AbstractContextManager["FitProgress"]):
    """Shows fits, a bar for one after the other. A context that closes the last bar.

    A fit calls it with the updates so far, and the score of the last validation.
    """

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        # Log files get a line every ten seconds at most.
        self._every_s = 0.1 if sys.stderr.isatty() else 10.0

    def __call__(self, progress: Progress) -> None:
        """Called by the fit after every update."""
        # Another name: the next fit has begun.
        if self._bar is None or self._bar.desc != progress.name:
            self.__exit__()
            self._bar = tqdm(
                total=progress.updates,
                desc=progress.name,
                unit="update",
                file=sys.stderr,
                mininterval=self._every_s,
            )
        if progress.score is not None:
            scores = f"validation score {progress.score:.4f}, best {progress.best:.4f}"
            self._bar.set_postfix_str(scores, refresh=False)
        # By the difference, since a resumed fit does not begin with the first update.
        self._bar.update(progress.update - self._bar.n)

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()


def _percent(change: float) -> str:
    return f"{change:+.1f} %"


def fold_tables(folds: Mapping[str, Any]) -> str:
    """What :func:`ganlane.generator.cross_validate` scored, but for single scenes, as text."""
    scores = folds["open_loop"]
    tables = [
        errors_table(scores, "of all folds"),
        _parts("by fold", scores["folds"]),
    ]
    if "rollout" in folds:
        tables.append(_rollout(folds["rollout"]))
    return "\n\n".join(map(aligned, tables))


def errors_table(scores: Mapping[str, Any], which: str) -> Lines:
    """ADE and FDE of all forecasts over the windows ``which``; the ADE to constant velocity's."""
    heading = [
        f"{scores['windows']} windows {which}",
        "ADE, m",
        "FDE, m",
        "ADE to CV",
    ]
    lines = [heading]
    for kind, ade_m in scores["ade_m"].items():
        fde_m = scores["fde_m"][kind]
        change = scores["ade_change_percent"][kind]
        lines.append([kind, f"{ade_m:.3f}", f"{fde_m:.3f}", _percent(change)])
    return lines


def _parts(title: str, parts: Mapping[str, Any]) -> Lines:
    """Windows, constant velocity's ADE and the generator's change relative to it, for each part."""
    # The mean of the samples, one sample, and the best of several: different questions.
    generated = ("mean", "single", f"best_of_{SAMPLES}")
    # All parts have the same forecasts.
    first = next(iter(parts.values()))
    kinds = [kind for kind in generated if kind in first["ade_m"]]
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
    """RMSE after 1 to 5 s, and relative to constant velocity's."""
    rmse = rollout["rmse_m"]
    heading = [
        f"RMSE, m ({rollout['windows']} windows)",
        *rmse[BASELINE],
        "to CV",
    ]
    lines = [heading]
    for kind, ratio in rollout["ratio_to_constant_velocity"].items():
        numbers = [*rmse[kind].values(), ratio]
        lines.append([kind, *(f"{number:.2f}" for number in numbers)])
    return lines
