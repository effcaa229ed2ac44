"""``ganlane train_generator``: fit a generator to recorded traffic and measure it on scenes it was not fitted to.

    ganlane train_generator data=scenes data.path=recordings.csv
    ganlane train_generator generator=calibrated data.path=recordings.csv seed=1
    ganlane train_generator data=ngsim data.path=ngsim.csv
    ganlane train_generator data=highd data.path=highD/data
    ganlane train_generator generator=paper data=scenes folds=5
    ganlane evaluate 'traffics=[gan]' generator.path=outputs/train_generator/RUN/generator_paper.safetensors

Writes generator_PRESET.safetensors (weights, metrics, lane-change statistics) and results.json into its run folder.
With folds=5 five more generators are fitted, each without the scenes of its fold, and saved next to it as
generator_PRESET_fold_1.safetensors and so on; results.json pools their errors on these scenes. With ablations=true
the preset is also fitted with one part changed at a time. resume=FOLDER continues the fits of an earlier run.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ganlane.config.app import run_command
from ganlane.config.recordings import TrainGeneratorConfig
from ganlane.errors import UserError
from ganlane.parameters.data import DataConfig, NgsimDataConfig

if TYPE_CHECKING:
    import polars as pl

    from ganlane.generator import FitResult


def train_generator(config: TrainGeneratorConfig, folder: Path) -> str:
    """Read the recordings, fit, print the errors on held-out scenes, save weights and results."""
    # Imported here, so that a mistake on the command line is reported before torch is loaded.
    from ganlane import generator
    from ganlane.evaluation import code_version, write_results
    from ganlane.evaluation.table import show
    from ganlane.fit_report import FitProgress, ablation_table, fold_tables, metrics_table, results_of
    from ganlane.runtime import set_threads

    set_threads(config.threads)
    source, frame = _recordings(config.data)
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


def _recordings(data: DataConfig) -> tuple[Path, pl.DataFrame]:
    """Path of the recordings, downloaded first if asked for, and all of their scenes."""
    from ganlane.data import byte_progress, default_scenes, download, read_recordings

    if data.format != "scenes" and data.path is None:
        raise UserError(f"data={data.format}: which file is missing; give data.path=FILE.")
    source = Path(data.path) if data.path else default_scenes()
    if isinstance(data, NgsimDataConfig) and data.download:
        with byte_progress("download") as progress:
            download(data.url, source, data.sha256, progress)
    with byte_progress("read") as progress:
        return source, read_recordings(data.format, source, data.parameters(), progress)


#: Entry point; takes the arguments of the command line, and returns the exit status.
main = partial(run_command, "train_generator", train_generator)


if __name__ == "__main__":
    sys.exit(main())
