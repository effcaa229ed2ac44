"""Everybody from the same starts, and what that is held against: here, the recorded scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ganlane.data import FRAME_S, driving_statistics, scene_lane_widths
from ganlane.errors import UserError
from ganlane.evaluation.realism.driving import FLOORS, Driven, Report, drive_all, measure_recordings
from ganlane.evaluation.realism.fitting import desired_speeds, mean_options
from ganlane.evaluation.realism.folds import Fold, merged
from ganlane.evaluation.realism.quantities import QUANTITIES, Measured
from ganlane.evaluation.realism.recordings import SHORTEST_S, Recording, recordings_of
from ganlane.evaluation.realism.reference import Reference, quantiles_of, rate, reference_of
from ganlane.evaluation.realism.simulation import StartOptions


@dataclass(frozen=True)
class Starts:
    """What was driven from the same starts, and what it is held against.

    Attributes:
        kind: ``recorded`` or ``spawned``.
        scenes: started from.
        held_out: by fold, the scenes that desired speeds were not fitted on.
        options: by traffic, how it was driven; over several folds the mean of what was fitted.
        driven: by name, the traffic of the card first, then its rivals, then :data:`FLOORS` (recorded starts only).
        recorded: by quantity, [units, bins] of the same scenes (spawned starts: of all).
        seen: what else those scenes show (lane changes, quantiles).
        reference: all recordings.
    """

    kind: str
    scenes: list[str]
    held_out: list[list[str]]
    options: Mapping[str, StartOptions]
    driven: Mapping[str, Driven]
    recorded: Mapping[str, np.ndarray]
    seen: Mapping[str, Any]
    reference: Reference

    @property
    def paired(self) -> bool:
        """Whether the recorded units are those that were driven."""
        return self.kind == "recorded"

    @property
    def unseen(self) -> list[str]:
        """The held-out scenes, where everybody started from others too; empty where all scenes are alike."""
        if len(self.held_out) != 1:
            return []
        unseen = [name for name in self.scenes if name in self.held_out[0]]
        return unseen if len(unseen) < len(self.scenes) else []

    def only(self, scenes: Sequence[str]) -> Starts:
        """The same driving, from these of its scenes alone, held against these."""
        rows = [self.scenes.index(name) for name in scenes]
        recorded = {name: counts[rows] for name, counts in self.recorded.items()}
        driven = {
            name: replace(each, counts={quantity: counts[rows] for quantity, counts in each.counts.items()})
            for name, each in self.driven.items()
        }
        return replace(self, scenes=list(scenes), driven=driven, recorded=recorded)

    def said(self) -> dict[str, Any]:
        """What ``results.json`` says of it."""
        excess = {name: each.desired_above_mps for name, each in self.options.items() if name not in FLOORS}
        return {
            "starts": self.kind,
            "scenes": self.scenes,
            "held_out": self.held_out,
            "desired_above_mps": excess,
            "recordings": self.reference.source,
            "recorded_lane_changes_per_vehicle_km": self.reference.rate(),
        }


def recorded_starts(
    folds: Sequence[Fold], frame: pl.DataFrame, options: StartOptions, fit: bool, source: str, report: Report
) -> Starts:
    """Everybody from the recorded scenes.

    Args:
        folds: who starts from which scenes; scenes that are too short are passed over.
        frame: the recordings, in the schema.
        options: how everybody is driven.
        fit: whether to fit every traffic's desired speeds on a fold's other scenes, or take those of ``options``.
        source: where the recordings come from.
        report: told what begins.

    Raises:
        UserError: a fold names what is no scene, or no scene is long enough.
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
    reference = reference_of(measure_recordings(every), names, _whole(frame, widths), source)
    return Starts(
        kind="recorded",
        scenes=[each.name for each in chosen],
        held_out=[list(fold.held_out) for fold in folds],
        options=mean_options([part.options for part in parts], options),
        driven={name: merged([part.driven[name] for part in parts]) for name in parts[0].driven},
        recorded={name: reference.counts[name][rows] for name in QUANTITIES},
        seen=_seen(measure_recordings(chosen)),
        reference=reference,
    )


class _Part(NamedTuple):
    """What a fold's traffics drove, and how."""

    scenes: list[Recording]
    options: Mapping[str, StartOptions]
    driven: Mapping[str, Driven]


def _drive_fold(
    fold: Fold, recordings: Sequence[Recording], options: StartOptions, fit: bool, report: Report
) -> _Part:
    """A fold's traffics from its scenes, with desired speeds fitted on the others; nothing without scenes."""
    scenes = [each for each in recordings if each.name in fold.starts]
    if not scenes:
        return _Part([], {}, {})
    others = [each for each in recordings if each.name not in fold.held_out] if fit else []
    chosen = desired_speeds(fold.makers, others, options, report)
    return _Part(scenes, chosen, drive_all(fold.makers, scenes, chosen, report))


def _whole(frame: pl.DataFrame, widths: dict[str, float]) -> dict[str, float]:
    """What all frames show, nothing left out: lane changes, vehicle-km, spread of speeds within a frame."""
    seen = driving_statistics(frame, widths)
    return {
        "lane_changes": seen.lane_changes.count,
        "vehicle_km": seen.exposure.vehicle_km,
        "speed_spread_mps": seen.speed_sd_in_frame or 0.0,
    }


def _check_names(held_out: Sequence[str], names: Sequence[str], source: str) -> None:
    for name in held_out:
        if name not in names:
            raise UserError(f"data.held_out={name}: no such scene in {source}; choose among {', '.join(names)}.")


def _seen(measured: Measured) -> dict[str, Any]:
    changes, km = sum(measured.lane_changes.values()), sum(measured.vehicle_km.values())
    return rate(changes, km) | {"quantiles": quantiles_of(measured)}
