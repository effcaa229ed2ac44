"""Make the realism card of a traffic: drive as configured, measure, show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import asdict, replace
from datetime import date
from pathlib import Path
from typing import Any, Final

from ganlane.build import make_road, make_traffic
from ganlane.settings.env import EnvConfig
from ganlane.settings.recordings import RealismConfig
from ganlane.config.run import stored_command
from ganlane.settings.traffic import TrafficConfig
from ganlane.data import data_folder, default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.evaluation import write_results
from ganlane.evaluation.table import show as show_tables
from ganlane.files import split_at_markers, write_between_markers, write_bytes
from ganlane.generator import HELD_OUT, Preset, shipped_generator
from ganlane.settings.record import assign
from ganlane.realism import measures
from ganlane.realism.card import Card, card_text, document_text, draw, floors_of, quantity_rows
from ganlane.realism.driving import Factory, StartOptions
from ganlane.realism.long_runs import LongRunParameters, long_run
from ganlane.realism.recordings import I80_FILES, read_i80
from ganlane.realism.starts import (
    Fold,
    Starts,
    check_folds_cover,
    fold_weights,
    print_progress,
    recorded_starts,
    simulate_all,
    spawned_starts,
)
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.torch_settings import set_threads
from ganlane.traffic import TrafficModule
from ganlane.weights import load_weights

#: Preset of the weights that a traffic drives with.
PRESETS: Final[Mapping[str, Preset]] = {"gan": "paper", "gan_calibrated": "calibrated"}
#: Quantities that one lane shows.
I80_QUANTITIES: Final = ("speed", "acceleration", "time_headway")


def realism(config: RealismConfig, folder: Path) -> str:
    """Make a card: drive, measure, print and save; the line that names its results."""
    config = config.shortened()
    set_threads(config.threads)
    path = scenes_path(config)
    check_targets(config, path)
    card = drive_card(config, path)
    drawn, numbers = draw(card, folder), card.numbers()
    if config.publish:
        publish(card.starts)
    show(config, folder, card_text(numbers, card.long_runs), numbers, drawn)
    seeds = {"stream": "report", "seed": config.seed}
    return f"results: {write_results(folder, numbers, asdict(config), seeds)}"


def drive_card(config: RealismConfig, path: Path | None) -> Card:
    """Drive the traffic and its rivals: from the same starts, on I-80, and in long runs.

    ``path`` is None where there are no recordings.

    Raises:
        UserError: recordings, weights or names that do not fit, or I-80 files that were asked for
            and are not there.
    """
    factories, files, traffic = (
        traffic_factories(config),
        i80_files_wanted(config, path),
        config.traffic.label(),
    )
    starts = drive_from_starts(config, factories, path)
    site = i80_cards(factories, files, starts.options, config.resamples)
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


def traffic_factories(
    config: RealismConfig, weights: Mapping[str, Path] | None = None
) -> dict[str, Factory]:
    """Factories by name: the card's traffic first, then its rivals.

    ``weights`` of a fold, by preset, replace those that generated traffics name themselves;
    :class:`UserError` where there are none of a preset.
    """
    every = {config.traffic.label(): config.traffic, **config.rivals()}
    if weights is not None:
        for name in [name for name in every if name in PRESETS]:
            path = weights.get(PRESETS[name])
            if path is None:
                raise UserError(
                    f"fold_weights: traffic {name} needs the preset {PRESETS[name]}, and a fold has no such file; "
                    "give one for every fold."
                )
            every[name] = replace(every[name], path=str(path))  # type: ignore[call-arg]
    return {name: _factory(traffic, config.env) for name, traffic in every.items()}


def _factory(traffic: TrafficConfig, env: EnvConfig) -> Factory:
    def make(road: Road) -> TrafficModule:
        # A copy that is not checked again: a recorded road need not fit Table II's vehicles.
        own = copy(env)
        assign(own, lanes=int(road.lanes), lane_width_m=float(road.lane_width_m))
        return make_traffic(traffic, own, Stream.REPORT)

    return make


def folds_of(config: RealismConfig, scenes: Sequence[str]) -> list[Fold]:
    """The scenes that traffics start from: the held-out ones, all, or all by folds."""
    if not config.fold_weights:
        everywhere = config.scenes == "all"
        # Nothing is held out of recordings that nothing is fitted to.
        held_out = (
            ()
            if everywhere and not _fits(config, scenes)
            else config.data.held_out_scenes(scenes, HELD_OUT)
        )
        if not everywhere and not held_out:
            raise UserError(
                f"recordings of one scene, {', '.join(scenes)}: none is held out to start from; give scenes=all, or "
                "cut it into several with ganlane prepare ... scene_s=30."
            )
        return [Fold(traffic_factories(config), scenes if everywhere else held_out, held_out)]
    folds = fold_weights([Path(path) for path in config.fold_weights])
    check_folds_cover(list(folds), scenes)
    return [
        Fold(traffic_factories(config, weights), held_out, held_out)
        for held_out, weights in folds.items()
    ]


def _fits(config: RealismConfig, scenes: Sequence[str]) -> bool:
    """Whether anything is, or was, fitted to some of the ``scenes``, or the user says which were
    held out.
    """
    if config.data.held_out is not None or config.desired_above_mps is None:
        return True
    used = {**config.rivals(), config.traffic.label(): config.traffic}
    for name in PRESETS.keys() & used.keys():
        path = getattr(used[name], "path", None) or shipped_generator(PRESETS[name])
        data = load_weights(path, "generator")[1].get("data", {})
        if set(scenes) & {*data.get("fitted", ()), *data.get("validation", ())}:
            return True
    return False


def drive_from_starts(
    config: RealismConfig, factories: Mapping[str, Factory], path: Path | None
) -> Starts:
    """Drive every traffic from recorded scenes, or from spawned ones where there are none."""
    if path is None:
        spawn = config.env.spawn_parameters()
        return spawned_starts(factories, make_road(config.env), spawn, config.repeats, config.seed)
    frame = read_scenes(path)
    folds = folds_of(config, sorted(frame["scene"].unique().to_list()))
    fit, options = (
        config.desired_above_mps is None,
        StartOptions(repeats=config.repeats, seed=config.seed),
    )
    if config.desired_above_mps is not None:
        options = replace(options, desired_above_mps=config.desired_above_mps)
    return recorded_starts(folds, frame, options, fit, str(path))


def i80_files_wanted(config: RealismConfig, path: Path | None) -> dict[str, Path]:
    """The I-80 files next to the scenes that ``config`` asks for, by name."""
    folder = None if config.i80 is False or path is None else path.parent
    files = {
        name: folder / file
        for name, file in I80_FILES.items()
        if folder and (folder / file).is_file()
    }
    if config.i80 and not files:
        raise UserError(
            f"i80=true: none of {', '.join(I80_FILES.values())} lies next to the scenes; use i80=false."
        )
    return files


def i80_cards(
    factories: Mapping[str, Factory],
    files: Mapping[str, Path],
    options: Mapping[str, StartOptions],
    resamples: int,
) -> dict[str, Any]:
    """By I-80 file, the rows of the first of ``factories``; nothing is fitted to the site."""
    cards, once = {}, {name: replace(each, repeats=1) for name, each in options.items()}
    for name, path in files.items():
        recordings = read_i80(name, path)
        driven, measured = (
            simulate_all(factories, recordings, once),
            measures.measure_recordings(recordings),
        )
        recorded = {quantity: measured.counts[quantity] for quantity in I80_QUANTITIES}
        cards[name] = quantity_rows(
            next(iter(factories)), driven, recorded, {}, resamples=resamples
        )
    return cards


def long_runs(config: RealismConfig, name: str, make: Factory) -> list[dict[str, Any]]:
    """One long run of a traffic per number of vehicles."""
    spawn, runs = config.env.spawn_parameters(), []
    for vehicles in config.long_vehicles if config.vehicle_km > 0 else []:
        parameters = LongRunParameters(
            vehicles, config.vehicle_km, config.long_s, config.seed, spawn
        )

        def report(km: float, vehicles: int = vehicles) -> None:
            print_progress(
                f"{name}, long run of {vehicles} vehicles: {km:.0f} of {config.vehicle_km:g} vehicle-km"
            )

        runs.append(long_run(make, make_road(config.env), parameters, report))
    return runs


def check_targets(config: RealismConfig, path: Path | None) -> None:
    """Raise :class:`UserError`, before anything is driven, if the results could not be written."""
    if config.publish and path is None:
        raise UserError(
            "publish=true: the file that ships is made from recordings; give data.path=FILE."
        )
    if config.report is not None:
        split_at_markers(Path(config.report), *markers(config.card()))
    if config.figures is not None and not Path(config.figures).is_dir():
        raise UserError(f"figures={config.figures}: no such folder; make it, or name another.")


def show(
    config: RealismConfig,
    folder: Path,
    tables: list[str],
    numbers: Mapping[str, Any],
    drawn: Sequence[Path],
) -> None:
    """Print the tables; write tables and figures into a document if asked for."""
    show_tables(*tables, columns=config.columns)
    if config.report is not None:
        command = stored_command(
            folder, "python -m ganlane.realism", without=("report=", "figures=", "hydra.")
        )
        text = document_text(tables, numbers, command, date.today().isoformat())
        write_between_markers(Path(config.report), *markers(config.card()), f"\n{text}\n")
    for path in drawn if config.figures is not None else []:
        write_bytes(Path(str(config.figures)) / f"realism_{path.name}", path.read_bytes())


def publish(starts: Starts) -> None:
    """Write the file that ships, with the distances of the reference drivers measured in this run."""
    source = Path(starts.reference.source).name
    floors = floors_of(starts.driven, starts.recorded.counts)
    replace(starts.reference, floors=floors, source=source).save(measures.SHIPPED_REFERENCE)
    print_progress(f"wrote {measures.SHIPPED_REFERENCE}")


def markers(card: str) -> tuple[str, str]:
    """The lines that enclose a card in a document; its name holds traffic and starts."""
    return f"<!-- begin realism {card} -->", f"<!-- end realism {card} -->"
