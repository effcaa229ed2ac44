"""Which traffic starts from which scenes: nobody drives where it was fitted, unless asked to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from ganlane.errors import UserError
from ganlane.evaluation.realism.driving import Driven
from ganlane.evaluation.realism.quantities import QUANTITIES, Measured
from ganlane.evaluation.realism.simulation import Factory
from ganlane.files import load_weights


@dataclass(frozen=True)
class Fold:
    """Traffics, and the scenes that they start from.

    Attributes:
        makers: traffics by name, the card's own first; the same names in every fold.
        starts: scenes to start from.
        held_out: scenes that desired speeds are not fitted on.
    """

    makers: Mapping[str, Factory]
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


def check_cover(folds: Sequence[Sequence[str]], scenes: Sequence[str]) -> None:
    """Raise :class:`UserError` unless every scene is in exactly one fold."""
    held = [name for fold in folds for name in fold]
    for name in sorted({*held, *scenes}):
        if held.count(name) != 1 or name not in scenes:
            raise UserError(
                f"fold_weights: the scene {name} is held out {held.count(name)} times, expected once for every scene "
                f"of the recordings ({', '.join(scenes)}); give one generator per fold."
            )


def merged(parts: Sequence[Driven]) -> Driven:
    """Driving from different scenes as one."""
    changes: dict[str, int] = {}
    km: dict[str, float] = {}
    for part in parts:
        changes |= part.measured.lane_changes
        km |= part.measured.vehicle_km
    samples = {name: pl.concat([part.measured.samples[name] for part in parts]) for name in QUANTITIES}
    counts = {name: np.concatenate([part.counts[name] for part in parts]) for name in QUANTITIES}
    return Driven(counts, Measured(samples, changes, km))
