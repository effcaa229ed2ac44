"""Drives everything that a card is made of, from the command's configuration."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from ganlane.build import make_road, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.realism import RealismConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.data import data_folder, default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.generator import HELD_OUT
from ganlane.parameters.checks import assign
from ganlane.realism.card import Card, quantity_rows
from ganlane.realism.fit_speeds import Report, drive_all, measure_recordings, units_of
from ganlane.realism.long_runs import LongRunParameters, long_run
from ganlane.realism.recordings import I80_FILES, i80_files, read_i80
from ganlane.realism.replay_starts import Factory, StartOptions
from ganlane.realism.starts import Fold, Starts, check_folds_cover, fold_weights, recorded_starts, spawned_starts
from ganlane.sim.random import Stream
from ganlane.sim.road import Road
from ganlane.traffic import TrafficModule

#: Preset of the weights that a traffic drives with.
PRESETS = {"gan": "paper", "gan_calibrated": "calibrated"}
#: Quantities that one lane shows.
I80_QUANTITIES: Final = ("speed", "acceleration", "time_headway")


def print_progress(text: str) -> None:
    """Print a line of progress on stderr."""
    print(text, file=sys.stderr, flush=True)


def drive_card(config: RealismConfig, path: Path | None) -> Card:
    """Drive the traffic and its rivals: from the same starts, on I-80, and in long runs.

    Args:
        config: whose card, and how much is driven.
        path: the recordings; None where there are none.

    Raises:
        UserError: recordings, weights or names that do not fit, or I-80 files that were asked for and are not there.
    """
    factories, files, traffic = traffic_factories(config), i80_files_wanted(config, path), config.traffic.label()
    starts = drive_from_starts(config, factories, path)
    site = i80_cards(factories, files, starts.options, config.resamples, print_progress)
    far = factories if config.long_against else {traffic: factories[traffic]}
    runs = {name: long_runs(config, name, make) for name, make in far.items()}
    return Card(traffic, starts, site, runs, config.resamples)


def scenes_path(config: RealismConfig) -> Path | None:
    """The recordings; None where none are named and none are found."""
    if config.data.path:
        return Path(config.data.path)
    data_folder()  # a folder that was named must be there
    try:
        return default_scenes()
    except UserError:
        return None


def traffic_factories(config: RealismConfig, weights: Mapping[str, Path] | None = None) -> dict[str, Factory]:
    """Factories of traffic on a given road, by name: the card's traffic first, then its rivals.

    Args:
        config: names them.
        weights: of a fold, by preset; None takes those that the traffics name themselves.

    Raises:
        UserError: a generated traffic, and no weights of its preset.
    """
    every = {config.traffic.label(): config.traffic, **config.rivals()}
    if weights is not None:
        every = {name: _with_weights(name, traffic, weights) for name, traffic in every.items()}
    return {name: _factory(traffic, config.env) for name, traffic in every.items()}


def _factory(traffic: TrafficConfig, env: EnvConfig) -> Factory:
    def make(road: Road) -> TrafficModule:
        # A copy that is not checked again: a recorded road need not fit Table II's vehicles.
        own = copy(env)
        assign(own, lanes=int(road.lanes), lane_width_m=float(road.lane_width_m))
        return make_traffic(traffic, own, Stream.REPORT)

    return make


def _with_weights(name: str, traffic: TrafficConfig, weights: Mapping[str, Path]) -> TrafficConfig:
    """A generated traffic with the weights of a fold; others as they are."""
    if name not in PRESETS:
        return traffic
    if PRESETS[name] not in weights:
        raise UserError(
            f"fold_weights: traffic {name} needs the preset {PRESETS[name]}, and a fold has no such file; give one "
            "for every fold."
        )
    return replace(traffic, path=str(weights[PRESETS[name]]))  # type: ignore[call-arg]


def folds_of(config: RealismConfig, scenes: Sequence[str]) -> list[Fold]:
    """The scenes that traffics start from: the held-out ones, all, or all by folds."""
    if not config.fold_weights:
        held_out = config.data.held_out_scenes(scenes, HELD_OUT)
        return [Fold(traffic_factories(config), scenes if config.scenes == "all" else held_out, held_out)]
    folds = fold_weights([Path(path) for path in config.fold_weights])
    check_folds_cover(list(folds), scenes)
    return [Fold(traffic_factories(config, weights), held_out, held_out) for held_out, weights in folds.items()]


def drive_from_starts(config: RealismConfig, factories: Mapping[str, Factory], path: Path | None) -> Starts:
    """Drive every traffic from recorded scenes, or from spawned ones where there are none."""
    if path is None:
        spawn = config.env.spawn_parameters()
        return spawned_starts(factories, make_road(config.env), spawn, config.repeats, config.seed, print_progress)
    frame = read_scenes(path)
    folds = folds_of(config, sorted(frame["scene"].unique().to_list()))
    fit, options = config.desired_above_mps is None, StartOptions(repeats=config.repeats, seed=config.seed)
    if config.desired_above_mps is not None:
        options = replace(options, desired_above_mps=config.desired_above_mps)
    return recorded_starts(folds, frame, options, fit, str(path), print_progress)


def i80_files_wanted(config: RealismConfig, path: Path | None) -> dict[str, Path]:
    """The I-80 files next to the scenes that ``config`` asks for, by name."""
    files = {} if path is None or config.i80 is False else i80_files(path.parent)
    if config.i80 and not files:
        raise UserError(f"i80=true: none of {', '.join(I80_FILES.values())} lies beside the scenes; use i80=false.")
    return files


def i80_cards(
    factories: Mapping[str, Factory],
    files: Mapping[str, Path],
    options: Mapping[str, StartOptions],
    resamples: int,
    report: Report,
) -> dict[str, Any]:
    """By file, the rows of :func:`ganlane.realism.card.quantity_rows`; nothing is fitted to the site.

    Args:
        factories: traffics by name, the card's own first.
        files: by name (:func:`i80_files`).
        options: by traffic, how it is driven; each segment is driven once.
        resamples: of the bootstrap, over pairs or segments.
        report: called with a line of progress.
    """
    cards, once = {}, {name: replace(each, repeats=1) for name, each in options.items()}
    for name, path in files.items():
        recordings = read_i80(name, path)
        driven = drive_all(factories, recordings, once, report)
        measured, units = measure_recordings(recordings), units_of(recordings)
        recorded = {quantity: measured.counts(units, quantity) for quantity in I80_QUANTITIES}
        own, *_ = factories
        others = {other: each for other, each in driven.items() if other != own}
        cards[name] = quantity_rows(driven[own], others, recorded, {}, resamples=resamples)
    return cards


def long_runs(config: RealismConfig, name: str, make: Factory) -> list[dict[str, Any]]:
    """One long run of a traffic per number of vehicles."""
    spawn, runs = config.env.spawn_parameters(), []
    for vehicles in config.long_vehicles if config.vehicle_km > 0 else []:
        parameters = LongRunParameters(vehicles, config.vehicle_km, config.long_s, config.seed, spawn)

        def report(km: float, vehicles: int = vehicles) -> None:
            print_progress(f"{name}, long run of {vehicles} vehicles: {km:.0f} of {config.vehicle_km:g} vehicle-km")

        runs.append(long_run(make, make_road(config.env), parameters, report))
    return runs
