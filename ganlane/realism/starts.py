"""Every traffic from the same starts: recorded scenes, or spawned ones where there are no
recordings.

Recordings do not show how fast drivers would like to go, so the mean desired speed is fitted for
every traffic. Generators may be split into folds, so that no scene is driven by weights that were
fitted to it. Without recordings everything is compared with the histograms that ship.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ganlane.data import FRAME_S, driving_statistics, scene_lane_widths
from ganlane.errors import UserError
from ganlane.realism.driving import FLOORS, Factory, StartOptions, drive_recordings
from ganlane.realism.long_runs import EventCounter, LongRunParameters, drive_spawned
from ganlane.realism.measures import (
    QUANTITIES,
    SHIPPED_REFERENCE,
    Measured,
    Reference,
    measure,
    measure_recordings,
    pooled_distance,
)
from ganlane.realism.recordings import (
    SHORTEST_S,
    Recording,
    recorded_frame,
    recordings_of,
    units_of,
)
from ganlane.sim.spawn import SpawnParameters
from ganlane.sim.state import Road
from ganlane.weights import load_weights

#: Candidates for the mean excess of desired speeds over the speed at entry, m/s.
EXCESS_GRID = (2.0, 4.0, 6.0, 8.0, 11.0, 15.0, 20.0)
#: Spawned starts: vehicles of an episode, its seconds, and episodes per repeat.
_SPAWNED_VEHICLES, _SPAWNED_S, _SPAWNED_ROWS = 30, 30.0, 8


def print_progress(text: str) -> None:
    """Print a line of progress on stderr."""
    print(text, file=sys.stderr, flush=True)


def simulate(make: Factory, recordings: Sequence[Recording], options: StartOptions) -> Measured:
    """Drive the recordings with a traffic and measure it."""
    return measure(drive_recordings(make, recordings, options), units_of(recordings))


def simulate_all(
    factories: Mapping[str, Factory],
    recordings: Sequence[Recording],
    options: Mapping[str, StartOptions],
) -> dict[str, Measured]:
    """Drive every traffic and both reference drivers from the same starts."""
    driven = {}
    for name, make in {**factories, **FLOORS}.items():
        print_progress(f"{name} from {len(recordings)} recorded starts")
        driven[name] = simulate(make, recordings, options.get(name, StartOptions()))
    return driven


def fit_excess(
    make: Factory,
    recordings: Sequence[Recording],
    options: StartOptions,
    grid: Sequence[float] = EXCESS_GRID,
) -> float:
    """The mean excess of desired speeds, of ``grid``, at which a traffic is nearest to
    ``recordings``, m/s.

    Nearest by the mean distance over all quantities that need no lane change. Every traffic is
    fitted, so that none suffers from desired speeds chosen for another.
    """
    recorded = measure_recordings(recordings)

    def mean_distance(excess: float) -> float:
        driven = simulate(make, recordings, replace(options, desired_above_mps=excess, repeats=1))
        fitted_by = [name for name in QUANTITIES if name != "lane_change_duration"]
        values = [pooled_distance(driven.counts[name], recorded.counts[name]) for name in fitted_by]
        return float(np.nanmean(values))

    return min(grid, key=mean_distance)


def desired_speeds(
    factories: Mapping[str, Factory], fitted: Sequence[Recording], common: StartOptions
) -> dict[str, StartOptions]:
    """Options by traffic: desired speeds fitted to ``fitted``, if there are any.

    Reference drivers as ``common``.
    """
    chosen = {name: common for name in FLOORS}
    for name, make in factories.items():
        chosen[name] = common
        if fitted:
            print_progress(f"{name}: fitting desired speeds on {len(fitted)} scenes")
            chosen[name] = replace(common, desired_above_mps=fit_excess(make, fitted, common))
    return chosen


@dataclass(frozen=True)
class Starts:
    """Traffics driven from the same starts, and the recordings that they are compared with.

    Attributes:
        kind: ``recorded`` or ``spawned``.
        scenes: started from.
        held_out: by fold, the scenes that desired speeds were not fitted on.
        options: by traffic, how it was driven; over several folds the mean of what was fitted.
        driven: by name, the card's traffic first, then its rivals, then :data:`FLOORS` (recorded
            starts only).
        recorded: the same scenes (spawned starts: all recordings).
        reference: all recordings.
    """

    kind: str
    scenes: list[str]
    held_out: list[list[str]]
    options: Mapping[str, StartOptions]
    driven: Mapping[str, Measured]
    recorded: Measured | Reference
    reference: Reference

    @property
    def paired(self) -> bool:
        """Whether the recorded units are those that were driven."""
        return self.kind == "recorded"

    @property
    def separately_held_out(self) -> list[str]:
        """The held-out scenes, if other scenes were driven too; else empty."""
        if len(self.held_out) != 1:
            return []
        held_out = [name for name in self.scenes if name in self.held_out[0]]
        return held_out if len(held_out) < len(self.scenes) else []

    def restricted_to(self, scenes: Sequence[str]) -> Starts:
        """The same driving from some of its scenes, compared with these alone."""
        assert isinstance(self.recorded, Measured)  # spawned starts are of no scenes
        rows = [self.scenes.index(name) for name in scenes]
        driven = {name: each.restricted_to(rows) for name, each in self.driven.items()}
        return replace(
            self, scenes=list(scenes), driven=driven, recorded=self.recorded.restricted_to(rows)
        )

    def description(self) -> dict[str, Any]:
        """The entries of ``results.json`` about starts and recordings."""
        excess = {
            name: each.desired_above_mps
            for name, each in self.options.items()
            if name not in FLOORS
        }
        return {
            "starts": self.kind,
            "scenes": self.scenes,
            "held_out": self.held_out,
            "desired_above_mps": excess,
            "recordings": self.reference.source,
            "recorded_lane_changes_per_vehicle_km": self.reference.rate(),
        }


@dataclass(frozen=True)
class Fold:
    """Traffics by name, the card's own first and the same in every fold, and the scenes that they
    start from.

    Desired speeds are not fitted on the ``held_out`` scenes.
    """

    factories: Mapping[str, Factory]
    starts: Sequence[str]
    held_out: Sequence[str]


def fold_weights(paths: Sequence[Path]) -> dict[tuple[str, ...], dict[str, Path]]:
    """Weights of k folds: by held-out scenes, then by preset (``paper``, ``calibrated``).

    Raises:
        UserError: a file is not a generator's, names no held-out scenes, or two files are of one
            fold and preset.
    """
    folds: dict[tuple[str, ...], dict[str, Path]] = {}
    for path in paths:
        metadata = load_weights(path, "generator")[1]
        held_out = tuple(sorted(metadata.get("data", {}).get("held_out", ())))
        preset = str(metadata.get("preset"))
        if not held_out or preset in folds.get(held_out, {}):
            raise UserError(
                f"fold_weights={path}: expected one generator per preset and fold, each fitted without the scenes of "
                f"its fold; this one is of the preset {preset}, left out: {', '.join(held_out) or 'none'}."
            )
        folds.setdefault(held_out, {})[preset] = path
    return folds


def check_folds_cover(folds: Sequence[Sequence[str]], scenes: Sequence[str]) -> None:
    """Raise :class:`UserError` unless every scene is in exactly one fold."""
    held = [name for fold in folds for name in fold]
    for name in sorted({*held, *scenes}):
        if held.count(name) != 1 or name not in scenes:
            raise UserError(
                f"fold_weights: the scene {name} is held out {held.count(name)} times, expected once for every scene "
                f"of the recordings ({', '.join(scenes)}); give one generator per fold."
            )


def recorded_starts(
    folds: Sequence[Fold], frame: pl.DataFrame, options: StartOptions, fit: bool, source: str
) -> Starts:
    """Drive every traffic from recorded scenes (``frame``, in the schema); those that are too short
    are skipped.

    ``fit``: every traffic's desired speeds, on a fold's other scenes; else they are those of
    ``options``.

    Raises:
        UserError: a fold names an unknown scene, or no scene is long enough.
    """
    widths = scene_lane_widths(frame)
    every = recordings_of(frame, widths)
    names = [each.name for each in every]
    for name in (name for fold in folds for name in fold.held_out):
        if name not in names:
            raise UserError(
                f"data.held_out={name}: no such scene in {source}; choose among {', '.join(names)}."
            )
    long = [each for each in every if len(each.x) * FRAME_S >= SHORTEST_S]
    chosen: list[Recording] = []
    fitted: list[dict[str, StartOptions]] = []
    driven: list[dict[str, Measured]] = []
    for fold in folds:
        scenes = [each for each in long if each.name in fold.starts]
        if scenes:
            others = [each for each in long if each.name not in fold.held_out] if fit else []
            fitted.append(desired_speeds(fold.factories, others, options))
            driven.append(simulate_all(fold.factories, scenes, fitted[-1]))
            chosen += scenes
    if not chosen:
        raise UserError(
            f"{source}: no scene to start from lasts {SHORTEST_S:g} s; give longer ones or scenes=all."
        )
    statistics = driving_statistics(frame, widths)
    whole = {
        "lane_changes": statistics.lane_changes.count,
        "vehicle_km": statistics.exposure.vehicle_km,
        "speed_spread_mps": statistics.speed_sd_in_frame or 0.0,
    }
    # Sites that belong to no fold get the mean over folds of the fitted desired speeds.
    means = {
        name: float(np.mean([part[name].desired_above_mps for part in fitted]))
        for name in fitted[0]
    }
    return Starts(
        kind="recorded",
        scenes=[each.name for each in chosen],
        held_out=[list(fold.held_out) for fold in folds],
        options={
            name: replace(options, desired_above_mps=excess) for name, excess in means.items()
        },
        driven={name: Measured.joined([part[name] for part in driven]) for name in driven[0]},
        recorded=measure_recordings(chosen),
        reference=Reference.of(measure_recordings(every), names, whole, source),
    )


def spawned_starts(
    factories: Mapping[str, Factory], road: Road, spawn: SpawnParameters, repeats: int, seed: int
) -> Starts:
    """Drive every traffic from the same spawned scenes: ``repeats`` times 8 episodes of 30 vehicles
    and 30 s each.

    ``road`` and ``spawn`` say where and how vehicles start (Table II at the paper's density). They
    are compared with the histograms that ship.
    """
    reference, rows = Reference.load(SHIPPED_REFERENCE), _SPAWNED_ROWS * repeats
    print_progress(
        f"no recordings here: spawned starts against {SHIPPED_REFERENCE.name}; give data.path=FILE for the fair "
        "comparison"
    )
    parameters = LongRunParameters(_SPAWNED_VEHICLES, most_s=_SPAWNED_S, seed=seed, spawn=spawn)
    scenes, driven = [f"spawned-{row}" for row in range(rows)], {}
    for name, make in factories.items():
        print_progress(f"{name} from {rows} spawned starts")
        driven[name] = measure(spawned_frame(make, road, parameters, rows), scenes)
    return Starts("spawned", [], [], {}, driven, reference, reference)


def spawned_frame(
    make: Factory, road: Road, parameters: LongRunParameters, rows: int
) -> pl.DataFrame:
    """Trajectories of ``rows`` spawned episodes of ``parameters.most_s`` s, in the form of measured
    recordings.
    """
    paths = drive_spawned(make(road), parameters, 0, rows, EventCounter(road))
    everywhere = np.ones(paths.x[:, 0].shape, dtype=bool)
    lanes, width = int(road.lanes), float(road.lane_width_m)
    made = []
    for row in range(rows):
        dense = (paths.x[:, row], paths.y[:, row], paths.speed[:, row], everywhere)
        name, sizes = f"spawned-{row}", (paths.length[row], paths.width[row])
        made.append(Recording(name, name, lanes, width, *dense, *sizes, everywhere[0]))
    return recorded_frame(made)
