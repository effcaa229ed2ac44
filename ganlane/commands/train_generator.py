"""Fit a generator to recordings and measure it on scenes that it was not fitted to."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ganlane import generator
from ganlane.config.recordings import TrainGeneratorConfig
from ganlane.data import byte_progress, read_recordings, recordings_path
from ganlane.evaluation import code_version, write_results
from ganlane.evaluation.table import show
from ganlane.fit_report import FitProgress, ablation_table, fold_tables, metrics_table, results_of
from ganlane.generator import FitResult
from ganlane.torch_settings import set_threads


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
        generator.assign_folds(scenes, config.folds)  # too many are refused now rather than after hours of ablations
    states = Path(config.resume or folder) / "fits"
    further: dict[str, Any] = {}
    if config.ablations:
        with FitProgress() as progress:
            further["ablations"] = generator.ablate(frame, fit_config, held_out, states, progress.next_fit, progress)
        show(ablation_table(further["ablations"]), columns=config.columns)
    if config.folds:

        def save(number: int, fold: FitResult) -> None:
            fold.save(folder / f"generator_{preset}_fold_{number}.safetensors", code=code_version())

        with FitProgress() as progress:
            further["folds"] = generator.cross_validate(
                frame, fit_config, config.folds, states, progress.next_fit, progress, save, source=str(source)
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
