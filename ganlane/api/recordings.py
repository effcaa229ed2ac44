"""``prepare`` and ``train_generator``: from recordings to a generator, as the commands do it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ganlane.api.folders import Run, results_of, run_in
from ganlane.api.options import Option, command_config
from ganlane.config.recordings import PrepareConfig, TrainGeneratorConfig


@dataclass(frozen=True)
class GeneratorRun(Run):
    """What fitting a generator left: also its weights, for ``traffic={"name": "gan", "path": weights}``."""

    weights: Path


def prepare(data: Option = "scenes", *, folder: str | Path | None = None, **overrides: Any) -> Run:
    """Recordings of any kind into one schema, as Parquet, with a report of what they show.

    ::

        run = prepare({"name": "ngsim", "path": "trajectories.txt"}, out="us101")

    On the command line: ``ganlane prepare data=ngsim data.path=trajectories.txt out=us101``.

    Args:
        data: ``scenes``, ``ngsim`` or ``highd`` with their keys.
        folder: where the report goes; None: a new one below ``outputs/prepare``.
        overrides: keys of the command: ``out``, ``scene_s``.

    Raises:
        UserError: a wrong value, or recordings that cannot be read.
    """
    from ganlane.prepare import prepare as command

    config = command_config(PrepareConfig, {"data": data}, overrides)
    home, _ = run_in(folder, "prepare", command, config)
    return Run(home, results_of(home))


def train_generator(
    data: Option = "scenes",
    generator: Option = "paper",
    *,
    seed: int = 0,
    folder: str | Path | None = None,
    **overrides: Any,
) -> GeneratorRun:
    """Fit a generator to recorded traffic and measure it on scenes it was not fitted to.

    ::

        run = train_generator({"path": "us101"}, "calibrated")
        env = make_env({"name": "gan_calibrated", "path": run.weights}, num_envs=64)

    On the command line: ``ganlane train_generator generator=calibrated data.path=us101``.

    Args:
        data: scenes, ``{"path": FILE}``; without, those of the recordings' folder.
        generator: ``paper`` or ``calibrated``, or a mapping of what differs.
        seed: of the fit.
        folder: where weights and errors go; None: a new one below ``outputs/train_generator``.
        overrides: keys of the command: ``folds``, ``ablations``, ``resume``.

    Raises:
        UserError: a wrong value, or recordings that cannot be read.
    """
    from ganlane.generator import preset_of
    from ganlane.train_generator import train_generator as command

    config = command_config(TrainGeneratorConfig, {"data": data, "generator": generator}, {**overrides, "seed": seed})
    home, _ = run_in(folder, "train_generator", command, config)
    weights = home / f"generator_{preset_of(config.generator)}.safetensors"
    return GeneratorRun(home, results_of(home), weights)
