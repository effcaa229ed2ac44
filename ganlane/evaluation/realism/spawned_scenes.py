"""Without recordings: everybody from the same spawned scenes, held against the histograms that ship."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl

from ganlane.evaluation.realism.counters import EventCounter
from ganlane.evaluation.realism.driving import Report, driven_of
from ganlane.evaluation.realism.long import LongRunParameters, drive_spawned, sizes
from ganlane.evaluation.realism.quantities import measure
from ganlane.evaluation.realism.recordings import Recording, frame_of
from ganlane.evaluation.realism.reference import SHIPPED_REFERENCE, Reference, rate
from ganlane.evaluation.realism.simulation import Factory
from ganlane.evaluation.realism.starts import Starts
from ganlane.sim.road import Road
from ganlane.sim.spawn import SpawnParameters

#: Vehicles of an episode, its seconds, and episodes per repeat.
_SPAWNED_VEHICLES, _SPAWNED_S, _SPAWNED_ROWS = 30, 30.0, 8


def spawned_starts(
    makers: Mapping[str, Factory],
    road: Road,
    spawn: SpawnParameters,
    repeats: int,
    seed: int,
    report: Report,
    path: Path = SHIPPED_REFERENCE,
) -> Starts:
    """Everybody from the same spawned scenes.

    Args:
        makers: traffics by name, the card's own first.
        road, spawn: where and how vehicles start (Table II at the paper's density).
        repeats: 8 episodes of 30 vehicles and 30 s each.
        seed: of the random numbers.
        report: told what begins.
        path: the histograms.
    """
    reference, rows = Reference.load(path), _SPAWNED_ROWS * repeats
    report(f"no recordings here: spawned starts against {path.name}; give data.path=FILE for the fair comparison")
    parameters = LongRunParameters(_SPAWNED_VEHICLES, most_s=_SPAWNED_S, seed=seed, spawn=spawn)
    scenes = [f"spawned-{row}" for row in range(rows)]
    widths, driven = dict.fromkeys(scenes, float(road.lane_width_m)), {}
    for name, make in makers.items():
        report(f"{name} from {rows} spawned starts")
        driven[name] = driven_of(measure(spawned_frame(make, road, parameters, rows), widths), scenes)
    seen = rate(reference.lane_changes, reference.vehicle_km) | {"quantiles": reference.quantiles}
    return Starts("spawned", [], [], {}, driven, reference.counts, seen, reference)


def spawned_frame(make: Factory, road: Road, parameters: LongRunParameters, rows: int) -> pl.DataFrame:
    """Trajectories of ``rows`` spawned episodes of ``parameters.most_s`` seconds, as recordings are measured."""
    traffic = make(road)
    course = drive_spawned(traffic, parameters, 0, rows, EventCounter(road))
    shape, (length, width) = course.x[:, 0].shape, sizes(traffic, parameters, 0, rows)
    nothing, everywhere = np.zeros(shape), np.ones(shape, dtype=bool)
    frames = []
    for row in range(rows):
        name, lanes, lane_width = f"spawned-{row}", int(road.lanes), float(road.lane_width_m)
        states = (nothing, nothing, nothing, everywhere)
        made = Recording(name, name, lanes, lane_width, *states, length[row], width[row], everywhere[0])
        frames.append(frame_of(made, course.x[:, row], course.y[:, row], everywhere, name))
    return pl.concat(frames)
