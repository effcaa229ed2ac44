"""A card: every traffic driven from the command's configuration, its distances to the recordings, and checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from ganlane.build import make_road, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.recordings import RealismConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.data import data_folder, default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.evaluation.statistics import Array, Estimate, entries
from ganlane.generator import HELD_OUT, Preset, shipped_generator
from ganlane.parameters.checks import assign
from ganlane.realism.driving import FLOORS, Factory, StartOptions
from ganlane.realism.long_runs import LongRunParameters, long_run, totals
from ganlane.realism.measures import (
    RESAMPLES,
    UNITS,
    Measured,
    ceiling,
    distance,
    distance_difference,
    measure_recordings,
    pooled_distance,
)
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
from ganlane.traffic import TrafficModule
from ganlane.weights import load_weights

#: Preset of the weights that a traffic drives with.
PRESETS: Final[Mapping[str, Preset]] = {"gan": "paper", "gan_calibrated": "calibrated"}
#: Quantities that one lane shows.
I80_QUANTITIES: Final = ("speed", "acceleration", "time_headway")
#: Quantities in which generated traffic should come closer to recordings than rules do.
CLOSER_IN = ("speed_spread", "acceleration", "time_headway", "time_to_collision", "lane_change_duration")


@dataclass(frozen=True)
class Card:
    """A traffic's card: the driving, and the numbers computed from it.

    Attributes:
        traffic: its name.
        starts: every traffic from the same starts.
        site: rows of a site that no generator was fitted to, by file; empty without it.
        long_runs: by traffic, this one's first; each with a run per number of vehicles.
        resamples: of the bootstrap.
    """

    traffic: str
    starts: Starts
    site: Mapping[str, Any]
    long_runs: Mapping[str, list[dict[str, Any]]]
    resamples: int

    @cached_property
    def quantities(self) -> dict[str, Any]:
        """Its rows, by quantity."""
        return card_rows(self.starts, self.traffic, self.resamples)

    def numbers(self) -> dict[str, Any]:
        """The content of ``results.json``."""
        starts, held_out = self.starts, self.starts.separately_held_out
        apart = card_rows(starts.restricted_to(held_out), self.traffic, self.resamples) if held_out else None
        driving = {name: each.summary() for name, each in {"recorded": starts.recorded, **starts.driven}.items()}
        own, recorded = (driving[name]["quantiles"] for name in (self.traffic, "recorded"))
        runs, rate, spread = self.long_runs[self.traffic], starts.reference.rate(), starts.reference.spread_mps
        checks = card_checks(self.quantities, own, recorded, rate["per_vehicle_km_ci"], spread, runs)
        return {
            "traffic": self.traffic,
            **starts.description(),
            "quantities": self.quantities,
            "quantities_held_out": apart,
            "driving": driving,
            "i80": self.site,
            **totals(runs),
            "long_runs": runs,
            "long_runs_against": {name: runs for name, runs in self.long_runs.items() if name != self.traffic},
            "checks": checks,
        }


def card_rows(starts: Starts, traffic: str, resamples: int) -> dict[str, Any]:
    """The rows of a traffic's card, compared with every other traffic from the same starts."""
    floors = starts.reference.floors
    return quantity_rows(traffic, starts.driven, starts.recorded.counts, floors, starts.paired, resamples)


def quantity_rows(
    traffic: str,
    driven: Mapping[str, Measured],
    recorded: Mapping[str, Array],
    floors: Mapping[str, Mapping[str, float]],
    paired: bool = True,
    resamples: int = RESAMPLES,
) -> dict[str, Any]:
    """By quantity: distance, ceiling, floor, constant velocity, and the difference to each rival.

    Args:
        traffic: whose rows.
        driven: it and others from the same starts; all but :data:`FLOORS` are rivals.
        recorded: by quantity, [units, bins]; its quantities are the rows. Their halves give the ceilings.
        floors: by driver and quantity, where ``driven`` does not hold the driver.
        paired: whether the recorded units are those that were driven.
    """
    rivals = [name for name in driven if name != traffic and name not in FLOORS]
    ends = {**floors, **floors_of(driven, recorded)}
    rows = {}
    for name, counts in recorded.items():
        own, against = driven[traffic].counts[name], {}
        for rival in rivals:
            other = driven[rival].counts[name]
            difference = distance_difference(own, other, counts, paired, resamples)
            against[rival] = {
                **entries("distance", distance(other, counts, paired, resamples)),
                **entries("difference", difference),
                "verdict": verdict(difference),
            }
        rows[name] = {
            "unit": UNITS[name],
            **entries("distance", distance(own, counts, paired, resamples)),
            "ceiling": ceiling(counts),
            "floor": ends.get("random", {}).get(name),
            "constant_velocity": ends.get("constant_velocity", {}).get(name),
            "samples": int(own.sum()),
            "recorded_samples": int(counts.sum()),
            "against": against,
        }
    return rows


def floors_of(driven: Mapping[str, Measured], recorded: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Finite distances of the reference drivers in ``driven`` to the recordings, by driver and quantity."""
    found: dict[str, dict[str, float]] = {}
    for floor in (name for name in FLOORS if name in driven):
        values = {name: pooled_distance(driven[floor].counts[name], counts) for name, counts in recorded.items()}
        found[floor] = {name: value for name, value in values.items() if math.isfinite(value)}
    return found


def verdict(difference: Estimate) -> str:
    """``closer`` or ``farther`` where the interval of the difference leaves out 0, else ``undecided``."""
    if not difference.excludes_zero():
        return "undecided"
    return "closer" if difference.value < 0.0 else "farther"


def card_checks(
    quantities: Mapping[str, Any],
    own: Mapping[str, Any],
    recorded: Mapping[str, Any],
    recorded_rate: Sequence[float] | None,
    spread_mps: float,
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The checks by name; None where the data to decide are missing.

    Args:
        quantities: the card's rows.
        own, recorded: quantiles of the traffic and of the recordings, from the same starts.
        recorded_rate: interval of the recorded lane changes per vehicle-km.
        spread_mps: recorded mean spread of speeds within a frame.
        runs: the long runs.
    """
    rivals: dict[str, dict[str, str]] = {}
    for name in CLOSER_IN:
        for other, row in quantities[name]["against"].items():
            rivals.setdefault(other, {})[name] = row["verdict"]
    pairs = [(own["acceleration"][level], recorded["acceleration"][level]) for level in ("0.05", "0.95")]
    near = None
    if all(None not in pair for pair in pairs):
        near = all(abs(mine - theirs) <= 0.3 * abs(theirs) for mine, theirs in pairs)
    return {
        "compared_with": rivals,
        "acceleration_quantiles_within_30_percent": near,
        "long_runs": [_run_checks(run, recorded_rate, spread_mps) for run in runs],
    }


def _run_checks(run: Mapping[str, Any], recorded_rate: Sequence[float] | None, spread_mps: float) -> dict[str, Any]:
    changes, overlaps = run["lane_changes_per_vehicle_km"], run["overlaps_per_1000_vehicle_km"]
    inside = None
    if changes is not None and recorded_rate:
        inside = recorded_rate[0] <= changes <= recorded_rate[1]
    spreads = [at["spread_mps"] for at in run["speeds"].values() if at["spread_mps"] is not None]
    wide = None if not spreads else min(spreads) >= 0.5 * spread_mps
    return {
        "vehicles": run["vehicles"],
        "lane_changes_inside_recorded_interval": inside,
        "overlaps_under_1_per_1000_vehicle_km": None if overlaps is None else overlaps < 1.0,
        "nobody_off_the_road": run["off_road"] == 0,
        "nobody_standing_in_free_flow": run["standstills_in_free_flow"] == 0,
        "spread_at_least_half_the_recorded": wide,
        "guard_under_5_percent": None if run["guard_share"] is None else run["guard_share"] < 0.05,
    }


def drive_card(config: RealismConfig, path: Path | None) -> Card:
    """Drive the traffic and its rivals: from the same starts, on I-80, and in long runs.

    ``path`` is None where there are no recordings.

    Raises:
        UserError: recordings, weights or names that do not fit, or I-80 files that were asked for and are not there.
    """
    factories, files, traffic = traffic_factories(config), i80_files_wanted(config, path), config.traffic.label()
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


def traffic_factories(config: RealismConfig, weights: Mapping[str, Path] | None = None) -> dict[str, Factory]:
    """Factories by name: the card's traffic first, then its rivals.

    ``weights`` of a fold, by preset, replace those that generated traffics name themselves; :class:`UserError` where
    there are none of a preset.
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
        held_out = () if everywhere and not _fits(config, scenes) else config.data.held_out_scenes(scenes, HELD_OUT)
        if not everywhere and not held_out:
            raise UserError(
                f"recordings of one scene, {', '.join(scenes)}: none is held out to start from; give scenes=all, or "
                "cut it into several with ganlane prepare ... scene_s=30."
            )
        return [Fold(traffic_factories(config), scenes if everywhere else held_out, held_out)]
    folds = fold_weights([Path(path) for path in config.fold_weights])
    check_folds_cover(list(folds), scenes)
    return [Fold(traffic_factories(config, weights), held_out, held_out) for held_out, weights in folds.items()]


def _fits(config: RealismConfig, scenes: Sequence[str]) -> bool:
    """Whether anything is, or was, fitted to some of the ``scenes``, or the user says which were held out."""
    if config.data.held_out is not None or config.desired_above_mps is None:
        return True
    used = {**config.rivals(), config.traffic.label(): config.traffic}
    for name in PRESETS.keys() & used.keys():
        path = getattr(used[name], "path", None) or shipped_generator(PRESETS[name])
        data = load_weights(path, "generator")[1].get("data", {})
        if set(scenes) & {*data.get("fitted", ()), *data.get("validation", ())}:
            return True
    return False


def drive_from_starts(config: RealismConfig, factories: Mapping[str, Factory], path: Path | None) -> Starts:
    """Drive every traffic from recorded scenes, or from spawned ones where there are none."""
    if path is None:
        spawn = config.env.spawn_parameters()
        return spawned_starts(factories, make_road(config.env), spawn, config.repeats, config.seed)
    frame = read_scenes(path)
    folds = folds_of(config, sorted(frame["scene"].unique().to_list()))
    fit, options = config.desired_above_mps is None, StartOptions(repeats=config.repeats, seed=config.seed)
    if config.desired_above_mps is not None:
        options = replace(options, desired_above_mps=config.desired_above_mps)
    return recorded_starts(folds, frame, options, fit, str(path))


def i80_files_wanted(config: RealismConfig, path: Path | None) -> dict[str, Path]:
    """The I-80 files next to the scenes that ``config`` asks for, by name."""
    folder = None if config.i80 is False or path is None else path.parent
    files = {name: folder / file for name, file in I80_FILES.items() if folder and (folder / file).is_file()}
    if config.i80 and not files:
        raise UserError(f"i80=true: none of {', '.join(I80_FILES.values())} lies next to the scenes; use i80=false.")
    return files


def i80_cards(
    factories: Mapping[str, Factory], files: Mapping[str, Path], options: Mapping[str, StartOptions], resamples: int
) -> dict[str, Any]:
    """By I-80 file, the rows of the first of ``factories``; nothing is fitted to the site."""
    cards, once = {}, {name: replace(each, repeats=1) for name, each in options.items()}
    for name, path in files.items():
        recordings = read_i80(name, path)
        driven, measured = simulate_all(factories, recordings, once), measure_recordings(recordings)
        recorded = {quantity: measured.counts[quantity] for quantity in I80_QUANTITIES}
        cards[name] = quantity_rows(next(iter(factories)), driven, recorded, {}, resamples=resamples)
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
