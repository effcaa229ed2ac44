"""Every traffic from the same starts: recorded scenes, or spawned ones where there are none.

Recordings do not show how fast drivers would like to go, so the mean desired speed is fitted for
every traffic. Without recordings everything is compared with the histograms that ship.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from ganlane.data.dense import Recording, recordings_of, units_of
from ganlane.data.schema import FRAME_S
from ganlane.data.statistics import driving_statistics
from ganlane.errors import UserError
from ganlane.realism.driving import (
    FLOORS,
    Factory,
    StartOptions,
    drive_recordings,
    print_progress,
)
from ganlane.realism.long_runs import EventCounter, LongRunParameters, drive_spawned
from ganlane.realism.measures import (
    QUANTITIES,
    SHIPPED_REFERENCE,
    Measured,
    Reference,
    measure,
    pooled_distance,
)
from ganlane.sim.spawn import SpawnParameters
from ganlane.sim.state import Road

#: A scene must last longer than the seconds that every measure leaves out, s.
SHORTEST_S = 4.0
#: Candidates for the mean excess of desired speeds over the speed at entry, m/s.
EXCESS_GRID = (2.0, 4.0, 6.0, 8.0, 11.0, 15.0, 20.0)
#: Spawned starts: vehicles of an episode, its seconds, and episodes per repeat.
_SPAWNED_VEHICLES = 30
_SPAWNED_S = 30.0
_SPAWNED_ROWS = 8


def simulate(make: Factory, recordings: Sequence[Recording], options: StartOptions) -> Measured:
    """Drive the recordings with a traffic and measure it."""
    return measure(drive_recordings(make, recordings, options), units_of(recordings))


def simulate_all(
    factories: Mapping[str, Factory],
    recordings: Sequence[Recording],
    options: StartOptions,
    desired_above_mps: Mapping[str, float],
) -> dict[str, Measured]:
    """Every traffic and both reference drivers from the same starts, measured.

    ``desired_above_mps`` by traffic takes the place of that of the ``options``.
    """
    driven = {}
    for name, make in {**factories, **FLOORS}.items():
        print_progress(f"{name} from {len(recordings)} recorded starts")
        # Reference drivers have no desired speed that matters.
        excess = desired_above_mps.get(name, options.desired_above_mps)
        driven[name] = simulate(make, recordings, replace(options, desired_above_mps=excess))
    return driven


def fit_excess(
    make: Factory,
    recordings: Sequence[Recording],
    options: StartOptions,
    grid: Sequence[float] = EXCESS_GRID,
) -> float:
    """The mean excess of desired speeds, of ``grid``, that brings a traffic nearest, m/s.

    Nearest to the ``recordings`` by the mean distance over all quantities that need no lane change.
    Every traffic is fitted, so that none suffers from desired speeds chosen for another.
    """
    recorded = measure(recordings)

    def mean_distance(excess: float) -> float:
        # Once per scene is enough to compare candidates with each other.
        driven = simulate(make, recordings, replace(options, desired_above_mps=excess, repeats=1))
        # Lane changes are too few to fit anything to.
        distances = [
            pooled_distance(driven.counts[name], recorded.counts[name])
            for name in QUANTITIES
            if name != "lane_change_duration"
        ]
        return float(np.nanmean(distances))

    return min(grid, key=mean_distance)


@dataclass(frozen=True)
class Starts:
    """Traffics driven from the same starts, and the recordings that they are compared with.

    Attributes:
        scenes: recorded scenes started from; empty where the starts were spawned.
        held_out: the scenes that desired speeds were not fitted on.
        desired_above_mps: by traffic, mean excess of desired speeds.
        driven: by name, the card's traffic first, then its rivals, then :data:`FLOORS` (recorded
            starts only).
        recorded: the same scenes (spawned starts: all recordings).
        reference: all recordings.
    """

    scenes: list[str]
    held_out: list[str]
    desired_above_mps: Mapping[str, float]
    driven: Mapping[str, Measured]
    recorded: Measured
    reference: Reference

    @property
    def paired(self) -> bool:
        """Whether the recorded units are those that were driven."""
        return bool(self.scenes)

    def held_out_alone(self) -> Starts | None:
        """The same driving from the held-out scenes, compared with these alone.

        None where no other scenes were driven, or none is held out.
        """
        # Units are the scenes, in this order.
        rows = [row for row, name in enumerate(self.scenes) if name in self.held_out]
        if not 0 < len(rows) < len(self.scenes):
            return None
        scenes = [self.scenes[row] for row in rows]
        driven = {name: measured.restricted_to(rows) for name, measured in self.driven.items()}
        return replace(
            self, scenes=scenes, driven=driven, recorded=self.recorded.restricted_to(rows)
        )


def recorded_starts(
    factories: Mapping[str, Factory],
    starts: Sequence[str],
    held_out: Sequence[str],
    frame: pl.DataFrame,
    options: StartOptions,
    fit: bool,
    source: str,
) -> Starts:
    """Drive every traffic from the recorded scenes ``starts`` of ``frame`` (in the schema).

    The shortest scenes are left out. ``fit``: every traffic's desired speeds, on the scenes that
    are not ``held_out``; else they are those of ``options``.

    Raises:
        UserError: an unknown scene is held out, or no scene is long enough.
    """
    recordings = recordings_of(frame)
    names = [recording.name for recording in recordings]
    # A mistyped scene would be fitted to in silence.
    for name in held_out:
        if name not in names:
            raise UserError(
                f"data.held_out={name}: no such scene in {source}; choose among {', '.join(names)}."
            )
    # Every measure leaves out the first 3 s.
    long = [recording for recording in recordings if len(recording.x) * FRAME_S >= SHORTEST_S]
    chosen = [recording for recording in long if recording.name in starts]
    if not chosen:
        raise UserError(
            f"{source}: no scene to start from lasts {SHORTEST_S:g} s; give longer ones or "
            "scenes=all."
        )
    # Never on the scenes that are held out, even if they are not driven.
    others = [recording for recording in long if recording.name not in held_out]
    excesses = dict.fromkeys(factories, options.desired_above_mps)
    if fit and others:
        for name, make in factories.items():
            print_progress(f"{name}: fitting desired speeds on {len(others)} scenes")
            excesses[name] = fit_excess(make, others, options)
    # Long runs are compared with all frames, not only with those that count.
    statistics = driving_statistics(frame)
    reference = Reference(
        **vars(measure(recordings)),
        source=source,
        units=names,
        whole={
            "lane_changes": statistics.lane_changes.count,
            "vehicle_km": statistics.exposure.vehicle_km,
            "speed_spread_mps": statistics.speed_sd_in_frame or 0.0,
        },
        floors={},
    )
    return Starts(
        scenes=units_of(chosen),
        held_out=list(held_out),
        desired_above_mps=excesses,
        driven=simulate_all(factories, chosen, options, excesses),
        recorded=measure(chosen),
        reference=reference,
    )


def spawned_starts(
    factories: Mapping[str, Factory], road: Road, spawn: SpawnParameters, repeats: int, seed: int
) -> Starts:
    """Drive every traffic from the same spawned scenes: 8 episodes per repeat, 30 vehicles, 30 s.

    ``road`` and ``spawn`` say where and how vehicles start (Table II at the paper's density). They
    are compared with the histograms that ship.
    """
    # The recordings may not be passed on; their histograms may.
    reference = Reference.load(SHIPPED_REFERENCE)
    rows = _SPAWNED_ROWS * repeats
    print_progress(
        f"no recordings here: spawned starts against {SHIPPED_REFERENCE.name}; give data.path=FILE "
        "for the fair comparison"
    )
    parameters = LongRunParameters(_SPAWNED_VEHICLES, most_s=_SPAWNED_S, seed=seed, spawn=spawn)
    driven = {}
    for name, make in factories.items():
        print_progress(f"{name} from {rows} spawned starts")
        driven[name] = measure(spawned_recordings(make, road, parameters, rows))
    return Starts([], [], {}, driven, reference, reference)


def spawned_recordings(
    make: Factory, road: Road, parameters: LongRunParameters, rows: int
) -> list[Recording]:
    """``rows`` spawned episodes of ``parameters.most_s`` s, in the form of recordings."""
    # Events are counted because driving counts them; nobody reads them here.
    paths = drive_spawned(make(road), parameters, 0, rows, EventCounter(road))
    # Nobody enters late or leaves.
    everywhere = np.ones(paths.x[:, 0].shape, dtype=bool)
    lane_width_m = float(road.lane_width_m)
    return [
        Recording(
            name=f"spawned-{row}",
            unit=f"spawned-{row}",
            lanes=int(road.lanes),
            lane_width_m=lane_width_m,
            lane=np.rint(paths.y[:, row] / lane_width_m).astype(np.int64),
            present=everywhere,
            driven=everywhere[0],
            # Vehicles are the last dimension of all of them, rows the one before.
            **{name: values[..., row, :] for name, values in paths._asdict().items()},
        )
        for row in range(rows)
    ]
