"""Every traffic from the same starts: recorded scenes, or spawned ones where there are no recordings.

Generators may be split into folds, so that no scene is driven by weights that were fitted to it. Without recordings
everything is compared with the histograms that ship.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ganlane.data import FRAME_S, driving_statistics, scene_lane_widths
from ganlane.errors import UserError
from ganlane.files import load_weights
from ganlane.realism.counters import EventCounter
from ganlane.realism.fit_speeds import (
    FLOORS,
    Driven,
    Report,
    desired_speeds,
    drive_all,
    driven_from,
    mean_options,
    measure_recordings,
)
from ganlane.realism.long_runs import LongRunParameters, drive_spawned, sizes
from ganlane.realism.quantities import QUANTITIES, Measured, measure
from ganlane.realism.recordings import SHORTEST_S, Recording, frame_of, recordings_of
from ganlane.realism.references import SHIPPED_REFERENCE, Reference, quantiles_of, rate, reference_of
from ganlane.realism.replay_starts import Factory, StartOptions
from ganlane.sim.spawn import SpawnParameters
from ganlane.sim.state import Road

#: Vehicles of an episode, its seconds, and episodes per repeat.
_SPAWNED_VEHICLES, _SPAWNED_S, _SPAWNED_ROWS = 30, 30.0, 8


@dataclass(frozen=True)
class Starts:
    """Traffics driven from the same starts, and the recordings that they are compared with.

    Attributes:
        kind: ``recorded`` or ``spawned``.
        scenes: started from.
        held_out: by fold, the scenes that desired speeds were not fitted on.
        options: by traffic, how it was driven; over several folds the mean of what was fitted.
        driven: by name, the traffic of the card first, then its rivals, then :data:`FLOORS` (recorded starts only).
        recorded: by quantity, [units, bins] of the same scenes (spawned starts: of all).
        recorded_summary: lane changes and quantiles of those scenes.
        reference: all recordings.
    """

    kind: str
    scenes: list[str]
    held_out: list[list[str]]
    options: Mapping[str, StartOptions]
    driven: Mapping[str, Driven]
    recorded: Mapping[str, np.ndarray]
    recorded_summary: Mapping[str, Any]
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
        rows = [self.scenes.index(name) for name in scenes]
        recorded = {name: counts[rows] for name, counts in self.recorded.items()}
        driven = {
            name: replace(each, counts={quantity: counts[rows] for quantity, counts in each.counts.items()})
            for name, each in self.driven.items()
        }
        return replace(self, scenes=list(scenes), driven=driven, recorded=recorded)

    def description(self) -> dict[str, Any]:
        """The entries of ``results.json`` about starts and recordings."""
        excess = {name: each.desired_above_mps for name, each in self.options.items() if name not in FLOORS}
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
    """Traffics, and the scenes that they start from.

    Attributes:
        factories: traffics by name, the card's own first; the same names in every fold.
        starts: scenes to start from.
        held_out: scenes that desired speeds are not fitted on.
    """

    factories: Mapping[str, Factory]
    starts: Sequence[str]
    held_out: Sequence[str]


def fold_weights(paths: Sequence[Path]) -> dict[tuple[str, ...], dict[str, Path]]:
    """Weights of k folds: by held-out scenes, then by preset (``paper``, ``calibrated``).

    Raises:
        UserError: a file is not a generator's, names no held-out scenes, or two files are of one fold and preset.
    """
    folds: dict[tuple[str, ...], dict[str, Path]] = {}
    for path in paths:
        metadata = load_weights(path, "generator")[1]
        held_out = tuple(sorted(metadata.get("data", {}).get("held_out", ())))
        preset = str(metadata.get("preset"))
        if not held_out or preset in folds.get(held_out, {}):
            raise UserError(
                f"fold_weights={path}: expected one generator per preset and fold, each fitted without the scenes of "
                f"its fold; this one is of the preset {preset}, without {', '.join(held_out) or 'nothing'}."
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
    folds: Sequence[Fold], frame: pl.DataFrame, options: StartOptions, fit: bool, source: str, report: Report
) -> Starts:
    """Drives every traffic from recorded scenes.

    Args:
        folds: traffics and the scenes that they start from; scenes that are too short are skipped.
        frame: the recordings, in the schema.
        options: of the simulations.
        fit: whether to fit every traffic's desired speeds on a fold's other scenes, or take those of ``options``.
        source: where the recordings come from.
        report: called with a line of progress.

    Raises:
        UserError: a fold names an unknown scene, or no scene is long enough.
    """
    widths = scene_lane_widths(frame)
    every = recordings_of(frame, widths)
    names = [each.name for each in every]
    _check_names([name for fold in folds for name in fold.held_out], names, source)
    long = [each for each in every if len(each.x) * FRAME_S >= SHORTEST_S]
    parts = [_drive_fold(fold, long, options, fit, report) for fold in folds]
    parts = [part for part in parts if part.scenes]
    if not parts:
        raise UserError(f"{source}: no scene to start from lasts {SHORTEST_S:g} s; give longer ones or scenes=all.")
    chosen = [each for part in parts for each in part.scenes]
    rows = [names.index(each.name) for each in chosen]
    reference = reference_of(measure_recordings(every), names, _whole_recording(frame, widths), source)
    return Starts(
        kind="recorded",
        scenes=[each.name for each in chosen],
        held_out=[list(fold.held_out) for fold in folds],
        options=mean_options([part.options for part in parts], options),
        driven={name: merge_driven([part.driven[name] for part in parts]) for name in parts[0].driven},
        recorded={name: reference.counts[name][rows] for name in QUANTITIES},
        recorded_summary=_recorded_summary(measure_recordings(chosen)),
        reference=reference,
    )


class _Part(NamedTuple):
    """Driving of one fold: its scenes, and options and results by traffic."""

    scenes: list[Recording]
    options: Mapping[str, StartOptions]
    driven: Mapping[str, Driven]


def _drive_fold(
    fold: Fold, recordings: Sequence[Recording], options: StartOptions, fit: bool, report: Report
) -> _Part:
    """Drives a fold's traffics from its scenes, with desired speeds fitted on the others; empty without scenes."""
    scenes = [each for each in recordings if each.name in fold.starts]
    if not scenes:
        return _Part([], {}, {})
    others = [each for each in recordings if each.name not in fold.held_out] if fit else []
    chosen = desired_speeds(fold.factories, others, options, report)
    return _Part(scenes, chosen, drive_all(fold.factories, scenes, chosen, report))


def merge_driven(parts: Sequence[Driven]) -> Driven:
    """Joins driving from different scenes."""
    changes: dict[str, int] = {}
    km: dict[str, float] = {}
    for part in parts:
        changes |= part.measured.lane_changes
        km |= part.measured.vehicle_km
    samples = {name: pl.concat([part.measured.samples[name] for part in parts]) for name in QUANTITIES}
    counts = {name: np.concatenate([part.counts[name] for part in parts]) for name in QUANTITIES}
    return Driven(counts, Measured(samples, changes, km))


def _whole_recording(frame: pl.DataFrame, widths: dict[str, float]) -> dict[str, float]:
    """Lane changes, vehicle-km and the spread of speeds within a frame, of all frames."""
    statistics = driving_statistics(frame, widths)
    return {
        "lane_changes": statistics.lane_changes.count,
        "vehicle_km": statistics.exposure.vehicle_km,
        "speed_spread_mps": statistics.speed_sd_in_frame or 0.0,
    }


def _check_names(held_out: Sequence[str], names: Sequence[str], source: str) -> None:
    for name in held_out:
        if name not in names:
            raise UserError(f"data.held_out={name}: no such scene in {source}; choose among {', '.join(names)}.")


def _recorded_summary(measured: Measured) -> dict[str, Any]:
    changes, km = sum(measured.lane_changes.values()), sum(measured.vehicle_km.values())
    return rate(changes, km) | {"quantiles": quantiles_of(measured)}


def spawned_starts(
    factories: Mapping[str, Factory],
    road: Road,
    spawn: SpawnParameters,
    repeats: int,
    seed: int,
    report: Report,
    path: Path = SHIPPED_REFERENCE,
) -> Starts:
    """Drives every traffic from the same spawned scenes.

    Args:
        factories: traffics by name, the card's own first.
        road, spawn: where and how vehicles start (Table II at the paper's density).
        repeats: 8 episodes of 30 vehicles and 30 s each.
        seed: of the random numbers.
        report: called with a line of progress.
        path: the histograms.
    """
    reference, rows = Reference.load(path), _SPAWNED_ROWS * repeats
    report(f"no recordings here: spawned starts against {path.name}; give data.path=FILE for the fair comparison")
    parameters = LongRunParameters(_SPAWNED_VEHICLES, most_s=_SPAWNED_S, seed=seed, spawn=spawn)
    scenes = [f"spawned-{row}" for row in range(rows)]
    widths, driven = dict.fromkeys(scenes, float(road.lane_width_m)), {}
    for name, make in factories.items():
        report(f"{name} from {rows} spawned starts")
        driven[name] = driven_from(measure(spawned_frame(make, road, parameters, rows), widths), scenes)
    summary = rate(reference.lane_changes, reference.vehicle_km) | {"quantiles": reference.quantiles}
    return Starts("spawned", [], [], {}, driven, reference.counts, summary, reference)


def spawned_frame(make: Factory, road: Road, parameters: LongRunParameters, rows: int) -> pl.DataFrame:
    """Trajectories of ``rows`` spawned episodes of ``parameters.most_s`` s, in the form of measured recordings."""
    traffic = make(road)
    trajectories = drive_spawned(traffic, parameters, 0, rows, EventCounter(road))
    shape, (length, width) = trajectories.x[:, 0].shape, sizes(traffic, parameters, 0, rows)
    nothing, everywhere = np.zeros(shape), np.ones(shape, dtype=bool)
    frames = []
    for row in range(rows):
        name, lanes, lane_width = f"spawned-{row}", int(road.lanes), float(road.lane_width_m)
        states = (nothing, nothing, nothing, everywhere)
        made = Recording(name, name, lanes, lane_width, *states, length[row], width[row], everywhere[0])
        frames.append(frame_of(made, trajectories.x[:, row], trajectories.y[:, row], everywhere, name))
    return pl.concat(frames)
