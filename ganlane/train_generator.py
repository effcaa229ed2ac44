"""``ganlane train_generator``: fit a generator to recorded traffic and measure it on scenes it was not fitted to.

    ganlane train_generator data=scenes data.path=recordings.csv
    ganlane train_generator generator=calibrated data.path=recordings.csv seed=1
    ganlane evaluate traffics=[gan] generator.path=outputs/train_generator/RUN/generator_paper.safetensors

Writes generator_PRESET.safetensors (weights, metrics, lane-change statistics) and results.json into its run folder.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from ganlane.config.app import run_command
from ganlane.config.train_generator import TrainGeneratorConfig


def train_generator(config: TrainGeneratorConfig, folder: Path) -> str:
    """Read, fit, print the held-out errors beside constant velocity, save."""
    from ganlane.build import set_threads
    from ganlane.data import default_scenes, read_scenes
    from ganlane.evaluation import write_results
    from ganlane.fit_report import FitProgress, metrics_table, results_of
    from ganlane.generator import HELD_OUT, fit_generator

    set_threads(config.threads)
    source = Path(config.data.path) if config.data.path else default_scenes()
    frame = read_scenes(source)
    held_out = config.data.held_out_scenes(frame["scene"].unique().to_list(), HELD_OUT)
    preset = config.generator.preset_name()
    with FitProgress() as progress:
        result = fit_generator(
            preset,
            frame,
            held_out=held_out,
            config=config.generator.fit_config(config.seed),
            source=str(source),
            on_progress=progress,
        )
    print(metrics_table(result.metrics))
    weights = folder / f"generator_{preset}.safetensors"
    result.save(weights)
    print(f"weights: {weights}")
    path = write_results(folder, results_of(result), asdict(config), {"seed": config.seed, "held_out": held_out})
    return f"results: {path}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    return run_command("train_generator", train_generator, arguments)


if __name__ == "__main__":
    sys.exit(main())
