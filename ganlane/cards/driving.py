"""What the traffics of a card drive: recorded or spawned starts, a further site, long runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ganlane.build import make_road
from ganlane.cards.traffics import folds_of
from ganlane.config.realism import RealismConfig
from ganlane.data import data_folder, default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.evaluation.realism import (
    I80_FILES,
    Factory,
    LongRunParameters,
    StartOptions,
    Starts,
    i80_files,
    long_run,
    recorded_starts,
    spawned_starts,
)


def say(text: str) -> None:
    """Tell on stderr what goes on."""
    print(text, file=sys.stderr, flush=True)


def scenes_path(config: RealismConfig) -> Path | None:
    """The recordings; None where none are named and none are found."""
    if config.data.path:
        return Path(config.data.path)
    data_folder()  # a folder that was named must be there
    try:
        return default_scenes()
    except UserError:
        return None


def drive_from_starts(config: RealismConfig, makers: Mapping[str, Factory], path: Path | None) -> Starts:
    """Everybody from recorded scenes, or from spawned ones where there are none."""
    if path is None:
        spawn = config.env.spawn_parameters()
        return spawned_starts(makers, make_road(config.env), spawn, config.repeats, config.seed, say)
    frame = read_scenes(path)
    folds = folds_of(config, sorted(frame["scene"].unique().to_list()))
    fit, options = config.desired_above_mps is None, StartOptions(repeats=config.repeats, seed=config.seed)
    if config.desired_above_mps is not None:
        options = replace(options, desired_above_mps=config.desired_above_mps)
    return recorded_starts(folds, frame, options, fit, str(path), say)


def i80_beside(config: RealismConfig, path: Path | None) -> dict[str, Path]:
    """The I-80 files beside the scenes, by name, as far as they are wanted."""
    files = {} if path is None or config.i80 is False else i80_files(path.parent)
    if config.i80 and not files:
        raise UserError(f"i80=true: none of {', '.join(I80_FILES.values())} lies beside the scenes; use i80=false.")
    return files


def long_runs(config: RealismConfig, name: str, make: Factory) -> list[dict[str, Any]]:
    """One long run of a traffic per number of vehicles."""
    spawn, runs = config.env.spawn_parameters(), []
    for vehicles in config.long_vehicles if config.vehicle_km > 0 else []:
        parameters = LongRunParameters(vehicles, config.vehicle_km, config.long_s, config.seed, spawn)

        def report(km: float, vehicles: int = vehicles) -> None:
            say(f"{name}, long run of {vehicles} vehicles: {km:.0f} of {config.vehicle_km:g} vehicle-km")

        runs.append(long_run(make, make_road(config.env), parameters, report))
    return runs
