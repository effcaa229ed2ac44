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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ganlane.config.app import run_command
from ganlane.config.data import DataConfig, NgsimDataConfig
from ganlane.config.train_generator import TrainGeneratorConfig
from ganlane.errors import UserError

if TYPE_CHECKING:
    import polars as pl

    from ganlane.generator import CalibratedConfig, FitResult, PaperConfig, Preset, SceneTracks


@dataclass(frozen=True)
class _Fit:
    """What is fitted, to what, and where it is kept: unfinished fits in ``states``, weights in ``folder``."""

    preset: Preset
    config: PaperConfig | CalibratedConfig
    source: str
    frame: pl.DataFrame
    scenes: list[SceneTracks]
    held_out: tuple[str, ...]
    states: Path
    folder: Path

    def weights(self, suffix: str = "") -> Path:
        """The file of a generator's weights."""
        return self.folder / f"generator_{self.preset}{suffix}.safetensors"


def train_generator(config: TrainGeneratorConfig, folder: Path) -> str:
    """Read, fit, print the held-out errors beside constant velocity, save."""
    from ganlane.build import set_threads
    from ganlane.evaluation import write_results
    from ganlane.fit_report import results_of
    from ganlane.generator import assign_folds

    set_threads(config.threads)
    fit = _asked(config, folder)
    if config.folds:
        assign_folds(fit.scenes, config.folds)  # refused now rather than after hours of ablations
    further: dict[str, Any] = {}
    if config.ablations:
        further["ablations"] = _ablations(fit)
    if config.folds:
        further["folds"] = _folds(fit, config.folds)
    numbers = results_of(_fitted(fit, further.get("folds"))) | further
    path = write_results(folder, numbers, asdict(config), {"seed": config.seed, "held_out": fit.held_out})
    return f"results: {path}"


def _asked(config: TrainGeneratorConfig, folder: Path) -> _Fit:
    """The fit that ``config`` asks for, its recordings read."""
    from ganlane.generator import HELD_OUT, scene_tracks

    source, frame = _recordings(config.data)
    return _Fit(
        preset=config.generator.preset_name(),
        config=config.generator.fit_config(config.seed),
        source=str(source),
        frame=frame,
        scenes=scene_tracks(frame),
        held_out=config.data.held_out_scenes(frame["scene"].unique().to_list(), HELD_OUT),
        states=Path(config.resume or folder) / "fits",
        folder=folder,
    )


def _ablations(fit: _Fit) -> dict[str, dict[str, Any]]:
    """Fit the preset with one part changed at a time; print and return the rows."""
    from ganlane.fit_report import FitProgress
    from ganlane.generator import ablate, ablation_table

    with FitProgress() as progress:
        rows = ablate(fit.preset, fit.frame, fit.config, fit.held_out, fit.states, progress.next_fit, progress)
    print(ablation_table(rows))
    return rows


def _folds(fit: _Fit, count: int) -> dict[str, Any]:
    """Fit without the scenes of one fold at a time, keep these generators; print and return the pooled errors."""
    from ganlane.evaluation.provenance import code_version
    from ganlane.fit_report import FitProgress
    from ganlane.generator import cross_validate, fold_tables

    def keep(number: int, fold: FitResult) -> None:
        fold.save(fit.weights(f"_fold_{number}"), code=code_version())

    with FitProgress() as progress:
        told = (progress.next_fit, progress, keep)
        folds = cross_validate(fit.preset, fit.frame, fit.config, count, fit.states, *told, source=fit.source)
    print(fold_tables(folds))
    return folds


def _fitted(fit: _Fit, folds: dict[str, Any] | None) -> FitResult:
    """The fit itself: print its errors, save its weights with what the ``folds`` gave."""
    from ganlane.evaluation.provenance import code_version
    from ganlane.fit_report import FitProgress, metrics_table
    from ganlane.generator import fit_generator, fit_key, split_for_fit

    key = fit_key(fit.preset, fit.config, split_for_fit(fit.scenes, fit.held_out))
    with FitProgress() as progress:
        result = fit_generator(
            fit.preset,
            fit.frame,
            held_out=fit.held_out,
            config=fit.config,
            source=fit.source,
            resume_path=fit.states / f"generator_{key}.pt",
            on_progress=progress,
        )
    print(metrics_table(result.metrics))
    result.save(fit.weights(), folds, code_version())
    print(f"weights: {fit.weights()}")
    return result


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
