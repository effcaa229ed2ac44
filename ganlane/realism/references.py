"""What recorded driving looks like, in numbers that ship: histograms, ceilings, floors; never an excerpt."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ganlane.errors import UserError
from ganlane.evaluation.counts import poisson_interval
from ganlane.evaluation.realism.distances import Array, ceiling
from ganlane.evaluation.realism.quantities import QUANTITIES, Measured
from ganlane.files import write_json
from ganlane.paths import CHECKPOINTS

#: The file that ships.
SHIPPED_REFERENCE = CHECKPOINTS / "realism_us101.json"
LEVELS = (0.05, 0.5, 0.95)
_KIND = "ganlane realism reference"


@dataclass(frozen=True)
class Reference:
    """Recorded driving.

    Attributes:
        source: where it was recorded.
        units: names of the scenes.
        counts: by quantity, [units, bins].
        quantiles: by quantity, by level as text.
        lane_changes, vehicle_km: from 3 s after each vehicle's first frame.
        whole: the same of all frames, nothing left out, and ``speed_spread_mps``: what long runs are held against.
        floors: by driver (``random``, ``constant_velocity``), by quantity: its distance from here.
    """

    source: str
    units: list[str]
    counts: Mapping[str, Array]
    quantiles: Mapping[str, Mapping[str, float | None]]
    lane_changes: int
    vehicle_km: float
    whole: Mapping[str, float]
    floors: Mapping[str, Mapping[str, float]]

    @property
    def ceilings(self) -> dict[str, float | None]:
        """By quantity: one half of the scenes against the other."""
        return {quantity: ceiling(counts) for quantity, counts in self.counts.items()}

    @property
    def spread_mps(self) -> float:
        """Recorded spread of speeds within a frame, its mean over the frames, m/s."""
        return self.whole["speed_spread_mps"]

    def rate(self) -> dict[str, Any]:
        """Lane changes per vehicle-km of the whole recording, with its exact interval."""
        return rate(int(self.whole["lane_changes"]), self.whole["vehicle_km"])

    def save(self, path: Path) -> None:
        """Write as JSON, atomically."""
        bins = {name: [b.low, b.high, b.number] for name, b in QUANTITIES.items()}
        plain = {**vars(self), "counts": {name: value.astype(int).tolist() for name, value in self.counts.items()}}
        write_json(path, {"kind": _KIND, "bins": bins, "ceilings": self.ceilings, **plain})

    @classmethod
    def load(cls, path: Path) -> Reference:
        """What :meth:`save` wrote.

        Raises:
            UserError: no such file, another file, or one with other bins.
        """
        try:
            numbers = json.loads(path.read_text())
            if numbers.pop("kind") != _KIND:
                raise ValueError("another kind of file")
            if numbers.pop("bins") != {name: [b.low, b.high, b.number] for name, b in QUANTITIES.items()}:
                raise ValueError("its histograms have other bins")
            numbers.pop("ceilings")
            counts = {name: np.asarray(value, dtype=np.float64) for name, value in numbers.pop("counts").items()}
            return cls(counts=counts, **numbers)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{path}: not the histograms of recorded driving that the realism card needs ({error}); give the "
                "recordings with data.path=FILE."
            ) from error


def rate(changes: int, km: float) -> dict[str, Any]:
    """Lane changes, vehicle-km, and their ratio with its exact 95 % interval."""
    interval = poisson_interval(changes).interval or []
    return {
        "lane_changes": changes,
        "vehicle_km": km,
        "per_vehicle_km": changes / km if km else None,
        "per_vehicle_km_ci": [bound / km for bound in interval] if km else None,
    }


def quantiles_of(measured: Measured) -> dict[str, dict[str, float | None]]:
    """By quantity, the quantiles at :data:`LEVELS`."""
    return {
        quantity: {f"{level:g}": measured.quantile(quantity, level) for level in LEVELS} for quantity in QUANTITIES
    }


def reference_of(
    measured: Measured,
    units: Sequence[str],
    whole: Mapping[str, float],
    source: str,
    floors: Mapping[str, Mapping[str, float]] | None = None,
) -> Reference:
    """The reference that measured recordings are."""
    return Reference(
        source=source,
        units=list(units),
        counts={quantity: measured.counts(units, quantity) for quantity in QUANTITIES},
        quantiles=quantiles_of(measured),
        lane_changes=sum(measured.lane_changes.values()),
        vehicle_km=sum(measured.vehicle_km.values()),
        whole=dict(whole),
        floors=floors or {},
    )
