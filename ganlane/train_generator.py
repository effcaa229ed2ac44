"""``ganlane train_generator``: fit a generator to recorded traffic and measure it on scenes it was not fitted to.

    ganlane train_generator data=scenes data.path=recordings.csv
    ganlane train_generator generator=calibrated data.path=recordings.csv seed=1
    ganlane train_generator data=ngsim data.path=ngsim.csv
    ganlane train_generator data=highd data.path=highD/data
    ganlane train_generator generator=paper data=scenes folds=5
    ganlane evaluate 'traffics=[gan]' generator.path=outputs/train_generator/RUN/generator_paper.safetensors

Writes generator_PRESET.safetensors (weights, metrics, lane-change statistics) and results.json into its run folder.
With folds=5 five more generators are fitted, each without the scenes of its fold, and kept beside it as
generator_PRESET_fold_1.safetensors and so on; results.json pools their errors on these scenes. With ablations=true
the preset is also fitted with one part changed at a time. resume=FOLDER goes on with what an earlier run has fitted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ganlane.config.app import run_command
from ganlane.config.data import DataConfig, NgsimDataConfig
from ganlane.config.train_generator import TrainGeneratorConfig
from ganlane.errors import UserError

if TYPE_CHECKING:
    import polars as pl

    from ganlane.generator import FitResult


def train_generator(config: TrainGeneratorConfig, folder: Path) -> str:
    """Read, fit, print the held-out errors beside constant velocity, save."""
    from ganlane.build import set_threads
    from ganlane.evaluation import write_results
    from ganlane.evaluation.provenance import code_version
    from ganlane.fit_report import FitProgress, metrics_table, results_of
    from ganlane.generator import (
        HELD_OUT,
        ablate,
        ablation_table,
        assign_folds,
        cross_validate,
        fit_generator,
        fit_key,
        fold_tables,
        scene_tracks,
        split_for_fit,
    )

    set_threads(config.threads)
    source, frame = _recordings(config.data)
    held_out = config.data.held_out_scenes(frame["scene"].unique().to_list(), HELD_OUT)
    preset = config.generator.preset_name()
    fit_config = config.generator.fit_config(config.seed)
    scenes = scene_tracks(frame)
    if config.folds:
        assign_folds(scenes, config.folds)  # refused now rather than after hours of ablations
    fits = Path(config.resume or folder) / "fits"
    numbers: dict[str, Any] = {}

    def keep_fold(number: int, fold: FitResult) -> None:
        fold.save(folder / f"generator_{preset}_fold_{number}.safetensors", code=code_version())

    if config.ablations:
        with FitProgress() as progress:
            rows = ablate(preset, frame, fit_config, held_out, fits, progress.next_fit, progress)
        print(ablation_table(rows))
        numbers["ablations"] = rows
    if config.folds:
        with FitProgress() as progress:
            told = (progress.next_fit, progress, keep_fold)
            folds = cross_validate(preset, frame, fit_config, config.folds, fits, *told, source=str(source))
        print(fold_tables(folds))
        numbers["folds"] = folds
    key = fit_key(preset, fit_config, split_for_fit(scenes, held_out))
    with FitProgress() as progress:
        result = fit_generator(
            preset,
            frame,
            held_out=held_out,
            config=fit_config,
            source=str(source),
            resume_path=fits / f"generator_{key}.pt",
            on_progress=progress,
        )
    print(metrics_table(result.metrics))
    weights = folder / f"generator_{preset}.safetensors"
    result.save(weights, numbers.get("folds"), code_version())
    print(f"weights: {weights}")
    numbers = results_of(result) | numbers
    path = write_results(folder, numbers, asdict(config), {"seed": config.seed, "held_out": held_out})
    return f"results: {path}"


def _recordings(data: DataConfig) -> tuple[Path, pl.DataFrame]:
    """Where the recordings lie, fetched first where asked to, and all of their scenes."""
    from ganlane.data import ByteProgress, default_scenes, download, read_recordings

    if data.format != "scenes" and data.path is None:
        raise UserError(f"data={data.format}: which file is missing; give data.path=FILE.")
    source = Path(data.path) if data.path else default_scenes()
    if isinstance(data, NgsimDataConfig) and data.download:
        with ByteProgress("download") as progress:
            download(data.url, source, data.sha256, progress)
    with ByteProgress("read") as progress:
        return source, read_recordings(data.format, source, data.parameters(), progress)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    return run_command("train_generator", train_generator, arguments)


if __name__ == "__main__":
    sys.exit(main())
