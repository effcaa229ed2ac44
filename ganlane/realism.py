"""``ganlane realism``: how close a traffic comes to recorded driving, as JSON, table and figures.

    ganlane realism traffic=gan_calibrated
    ganlane realism traffic=gan data.path=recordings.csv 'against=[idm_mobil,gan_calibrated]'
    ganlane realism traffic=idm traffic._target_=my.module.MyTraffic vehicle_km=100
    ganlane realism traffic=gan_calibrated scenes=all report=docs/realism.md figures=docs/figures
    ganlane realism traffic=idm quick=true

Writes results.json, distributions.png, distances.png and drift.png into its run folder. Without recordings on the
machine it uses the histograms that ship, and says so.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ganlane.config.app import run_command
from ganlane.config.realism import RealismConfig
from ganlane.errors import UserError

if TYPE_CHECKING:
    from ganlane.evaluation.realism import Factory, Fold, Starts


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


#: Preset of the weights that a traffic drives with.
PRESETS = {"gan": "paper", "gan_calibrated": "calibrated"}


def makers_of(config: RealismConfig, weights: Mapping[str, Path] | None = None) -> dict[str, Factory]:
    """Traffic of any road, by name: the one that the card is of, then its rivals.

    Args:
        config: names them.
        weights: of a fold, by preset; None takes those that the traffics name themselves.
    """
    from ganlane.build import make_traffic
    from ganlane.sim.random import Stream
    from ganlane.sim.road import Road
    from ganlane.traffic import TrafficModule

    def maker(traffic: Any) -> Factory:
        def make(road: Road) -> TrafficModule:
            # A copy that is not checked again: a recorded road need not fit Table II's vehicles.
            env = copy(config.env)
            env.lanes, env.lane_width_m = int(road.lanes), float(road.lane_width_m)
            return make_traffic(traffic, env, Stream.REPORT)

        return make

    every = {config.traffic.label(): config.traffic, **config.rivals()}
    if weights is not None:
        every = {name: _with_weights(name, traffic, weights) for name, traffic in every.items()}
    return {name: maker(traffic) for name, traffic in every.items()}


def _with_weights(name: str, traffic: Any, weights: Mapping[str, Path]) -> Any:
    """A generated traffic with the weights of a fold; others as they are."""
    if name not in PRESETS:
        return traffic
    if PRESETS[name] not in weights:
        raise UserError(
            f"fold_weights: traffic {name} needs the preset {PRESETS[name]}, and a fold has no such file; give one "
            "for every fold."
        )
    return replace(traffic, path=str(weights[PRESETS[name]]))


def folds_of(config: RealismConfig, scenes: Sequence[str]) -> list[Fold]:
    """Who starts from which of ``scenes``: the held-out ones (or all), or all by folds."""
    from ganlane.evaluation.realism import Fold, check_cover, fold_weights
    from ganlane.generator import HELD_OUT

    if not config.fold_weights:
        held_out = config.data.held_out_scenes(scenes, HELD_OUT)
        return [Fold(makers_of(config), scenes if config.scenes == "all" else held_out, held_out)]
    folds = fold_weights([Path(path) for path in config.fold_weights])
    check_cover(list(folds), scenes)
    return [Fold(makers_of(config, weights), held_out, held_out) for held_out, weights in folds.items()]


def scenes_path(config: RealismConfig) -> Path | None:
    """The recordings; None where none are named and none are found."""
    from ganlane.data import data_folder, default_scenes

    if config.data.path:
        return Path(config.data.path)
    data_folder()  # a folder that was named must be there
    try:
        return default_scenes()
    except UserError:
        return None


def drive_from_starts(config: RealismConfig, makers: Mapping[str, Factory], path: Path | None) -> Starts:
    """Everybody from recorded scenes, or from spawned ones where there are none."""
    from ganlane.build import make_road
    from ganlane.data import read_scenes
    from ganlane.evaluation.realism import StartOptions, recorded_starts, spawned_starts

    if path is None:
        spawn = config.env.spawn_parameters()
        return spawned_starts(makers, make_road(config.env), spawn, config.repeats, config.seed, _say)
    frame = read_scenes(path)
    folds = folds_of(config, sorted(frame["scene"].unique().to_list()))
    fit, options = config.desired_above_mps is None, StartOptions(repeats=config.repeats, seed=config.seed)
    if config.desired_above_mps is not None:
        options = replace(options, desired_above_mps=config.desired_above_mps)
    return recorded_starts(folds, frame, options, fit, str(path), _say)


def i80_beside(config: RealismConfig, path: Path | None) -> dict[str, Path]:
    """The I-80 files beside the scenes, by name, as far as they are wanted."""
    from ganlane.evaluation.realism import I80_FILES, i80_files

    files = {} if path is None or config.i80 is False else i80_files(path.parent)
    if config.i80 and not files:
        raise UserError(f"i80=true: none of {', '.join(I80_FILES.values())} lies beside the scenes; use i80=false.")
    return files


def long_runs(config: RealismConfig, name: str, make: Factory) -> list[dict[str, Any]]:
    """One long run of a traffic per number of vehicles."""
    from ganlane.build import make_road
    from ganlane.evaluation.realism import LongRunParameters, long_run

    spawn, runs = config.env.spawn_parameters(), []
    for vehicles in config.long_vehicles if config.vehicle_km > 0 else []:
        parameters = LongRunParameters(vehicles, config.vehicle_km, config.long_s, config.seed, spawn)

        def report(km: float, vehicles: int = vehicles) -> None:
            _say(f"{name}, long run of {vehicles} vehicles: {km:.0f} of {config.vehicle_km:g} vehicle-km")

        runs.append(long_run(make, make_road(config.env), parameters, report))
    return runs


def rows_of(starts: Starts, traffic: str, resamples: int) -> dict[str, Any]:
    """The rows of a traffic's card, by quantity."""
    from ganlane.evaluation.realism import quantity_rows

    others = {name: each for name, each in starts.driven.items() if name != traffic}
    own, held_against = starts.driven[traffic], (starts.recorded, starts.reference, starts.paired)
    return quantity_rows(own, others, *held_against, resamples=resamples)


def draw(
    starts: Starts, runs: Sequence[Mapping[str, Any]], own: Mapping[str, Any], name: str, to: Path
) -> list[Path]:
    """The figures of the traffic ``name``, whose rows are ``own``, into the folder ``to``."""
    from ganlane.view.realism import card_pictures, write_figure

    pictures = card_pictures(starts, runs, own, name)
    return [write_figure(picture, to / f"{title}.png") for title, picture in pictures.items()]


def show(
    config: RealismConfig, folder: Path, numbers: Mapping[str, Any], tables: list[str], drawn: list[Path]
) -> None:
    """The tables on stdout; tables and figures where a document wants them."""
    from datetime import date

    from ganlane.evaluation.realism import document_text, update_document
    from ganlane.files import write_bytes

    print(*tables, sep="\n\n")
    if config.report is not None:
        text = document_text(tables, numbers, command_line(folder), date.today().isoformat())
        update_document(Path(config.report), config.card(), text)
    for path in drawn if config.figures is not None else []:
        write_bytes(Path(str(config.figures)) / f"realism_{path.name}", path.read_bytes())


def command_line(folder: Path) -> str:
    """How the run in ``folder`` was started, without where its document and figures went."""
    import shlex

    from omegaconf import OmegaConf

    from ganlane.config.folders import OVERRIDES

    asked = [str(override) for override in OmegaConf.load(folder / OVERRIDES)]
    kept = [override for override in asked if not override.startswith(("report=", "figures=", "hydra."))]
    return shlex.join(["python", "-m", "ganlane.realism", *kept])


def publish(starts: Starts) -> None:
    """Write the file that ships, with the floors as they were just measured."""
    from ganlane.evaluation.realism import SHIPPED_REFERENCE, floors_of

    source = Path(starts.reference.source).name
    floors = floors_of(starts.driven, starts.recorded)
    replace(starts.reference, floors=floors, source=source).save(SHIPPED_REFERENCE)
    _say(f"wrote {SHIPPED_REFERENCE}")


def check_targets(config: RealismConfig, path: Path | None) -> None:
    """Raise :class:`UserError` where something cannot be written in the end, before anything is driven."""
    from ganlane.evaluation.realism import require_markers

    if config.publish and path is None:
        raise UserError("publish=true: the file that ships is made from recordings; give data.path=FILE.")
    if config.report is not None:
        require_markers(Path(config.report), config.card())
    if config.figures is not None and not Path(config.figures).is_dir():
        raise UserError(f"figures={config.figures}: no such folder; make it, or name another.")


def realism(config: RealismConfig, folder: Path) -> str:
    """Drive, measure, print, draw, keep."""
    from ganlane.build import set_threads
    from ganlane.evaluation import write_results
    from ganlane.evaluation.realism import card_checks, card_text, from_starts, i80_cards, totals

    config = config.shortened()
    set_threads(config.threads)
    makers, path, traffic = makers_of(config), scenes_path(config), config.traffic.label()
    check_targets(config, path)
    files = i80_beside(config, path)
    starts = drive_from_starts(config, makers, path)
    unseen, reference = starts.unseen, starts.reference
    quantities = rows_of(starts, traffic, config.resamples)
    driving = {"recorded": starts.seen, **from_starts(starts.driven)}
    site = i80_cards(makers, files, starts.options, config.resamples, _say)
    far = makers if config.long_against else {traffic: makers[traffic]}
    every = {name: long_runs(config, name, make) for name, make in far.items()}
    runs = every.pop(traffic)
    quantiles = (driving[traffic]["quantiles"], starts.seen["quantiles"])
    checks = card_checks(quantities, *quantiles, reference.rate(), reference.spread_mps, runs)
    drawn = draw(starts, runs, quantities, traffic, folder)
    if config.publish:
        publish(starts)
    numbers = {
        "traffic": traffic,
        **starts.said(),
        "quantities": quantities,
        "quantities_held_out": rows_of(starts.only(unseen), traffic, config.resamples) if unseen else None,
        "driving": driving,
        "i80": site,
        **totals(runs),
        "long_runs": runs,
        "long_runs_against": every,
        "checks": checks,
    }
    show(config, folder, numbers, card_text(numbers, {traffic: runs, **every}), drawn)
    seeds = {"stream": "report", "seed": config.seed}
    return f"results: {write_results(folder, numbers, asdict(config), seeds)}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    return run_command("realism", realism, arguments)


if __name__ == "__main__":
    sys.exit(main())
