"""Traffics and recordings, measured alike: everybody drives from the same recorded starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from ganlane.evaluation.realism.drivers import ConstantVelocity, RandomDriving
from ganlane.evaluation.realism.quantities import QUANTITIES, Measured, measure
from ganlane.evaluation.realism.recordings import Recording, recorded_frame
from ganlane.evaluation.realism.simulation import Factory, StartOptions, drive_recordings

#: The ends of the scale.
FLOORS: dict[str, Factory] = {"random": RandomDriving, "constant_velocity": ConstantVelocity}
#: Told what begins.
Report = Callable[[str], None]


@dataclass(frozen=True)
class Driven:
    """A traffic that drove: histograms [units, bins] by quantity, and what was measured."""

    counts: Mapping[str, np.ndarray]
    measured: Measured


def widths_of(frame: pl.DataFrame, recordings: Sequence[Recording]) -> dict[str, float]:
    """Lane width by the names of the frame's scenes (a recording's, with the run behind a ``#``)."""
    known = {each.name: each.lane_width_m for each in recordings}
    return {scene: known[scene.partition("#")[0]] for scene in frame["scene"].unique().to_list()}


def units_of(recordings: Sequence[Recording]) -> list[str]:
    """What is resampled, in order."""
    return list(dict.fromkeys(each.unit for each in recordings))


def measure_recordings(recordings: Sequence[Recording]) -> Measured:
    """The recordings, measured as simulations are."""
    frame = recorded_frame(recordings)
    return measure(frame, widths_of(frame, recordings))


def drive(make: Factory, recordings: Sequence[Recording], options: StartOptions) -> Driven:
    """Drive the recordings with a traffic and measure."""
    frame = drive_recordings(make, recordings, options)
    return driven_of(measure(frame, widths_of(frame, recordings)), units_of(recordings))


def driven_of(measured: Measured, units: Sequence[str]) -> Driven:
    """Measured driving with its histograms."""
    return Driven({quantity: measured.counts(units, quantity) for quantity in QUANTITIES}, measured)


def drive_all(
    makers: Mapping[str, Factory],
    recordings: Sequence[Recording],
    options: Mapping[str, StartOptions],
    report: Report,
) -> dict[str, Driven]:
    """Every traffic and both ends of the scale from the same starts."""
    every = {**makers, **FLOORS}
    driven = {}
    for name, make in every.items():
        report(f"{name} from {len(recordings)} recorded starts")
        driven[name] = drive(make, recordings, options.get(name, StartOptions()))
    return driven
