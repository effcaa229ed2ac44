"""The numbers of a card: every traffic's distances to the same recordings, rates, quantiles, and checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ganlane.evaluation.statistics import Estimate
from ganlane.realism.distances import RESAMPLES, ceiling, distance, distance_difference, pooled_distance
from ganlane.realism.fit_speeds import FLOORS, Driven
from ganlane.realism.long_runs import totals
from ganlane.realism.quantities import UNITS
from ganlane.realism.references import quantiles_of, rate
from ganlane.realism.starts import Starts

#: Quantities in which generated traffic should come closer to recordings than rules do.
CLOSER_IN = ("speed_spread", "acceleration", "time_headway", "time_to_collision", "lane_change_duration")
#: Largest relative error of an acceleration quantile; largest share of steps that a guard may alter.
_QUANTILE_SHARE = 0.3
_MOST_GUARD = 0.05


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

    @property
    def runs(self) -> list[dict[str, Any]]:
        """The traffic's own long runs."""
        return self.long_runs[self.traffic]

    @cached_property
    def quantities(self) -> dict[str, Any]:
        """Its rows, by quantity."""
        return card_rows(self.starts, self.traffic, self.resamples)

    def numbers(self) -> dict[str, Any]:
        """The content of ``results.json``."""
        starts, held_out = self.starts, self.starts.separately_held_out
        apart = card_rows(starts.restricted_to(held_out), self.traffic, self.resamples) if held_out else None
        driving = {"recorded": starts.recorded_summary, **driving_summary(starts.driven)}
        return {
            "traffic": self.traffic,
            **starts.description(),
            "quantities": self.quantities,
            "quantities_held_out": apart,
            "driving": driving,
            "i80": self.site,
            **totals(self.runs),
            "long_runs": self.runs,
            "long_runs_against": {name: runs for name, runs in self.long_runs.items() if name != self.traffic},
            "checks": self._checks(driving[self.traffic]["quantiles"]),
        }

    def _checks(self, own: Mapping[str, Any]) -> dict[str, Any]:
        recorded, reference = self.starts.recorded_summary["quantiles"], self.starts.reference
        return card_checks(self.quantities, own, recorded, reference.rate(), reference.spread_mps, self.runs)


def card_rows(starts: Starts, traffic: str, resamples: int = RESAMPLES) -> dict[str, Any]:
    """The rows of a traffic's card by quantity, with its difference to every other traffic from the same starts."""
    others = {name: each for name, each in starts.driven.items() if name != traffic}
    floors = starts.reference.floors
    return quantity_rows(starts.driven[traffic], others, starts.recorded, floors, starts.paired, resamples)


def quantity_rows(
    driven: Driven,
    others: Mapping[str, Driven],
    recorded: Mapping[str, np.ndarray],
    floors: Mapping[str, Mapping[str, float]],
    paired: bool = True,
    resamples: int = RESAMPLES,
) -> dict[str, Any]:
    """By quantity: distance, ceiling, floor, constant velocity, and the difference to each of ``others``.

    Args:
        driven: the traffic.
        others: further traffics from the same starts; ``random`` and ``constant_velocity`` become the floors.
        recorded: by quantity, [units, bins]; its quantities are the rows. Their halves give the ceilings.
        floors: by driver and quantity, where ``others`` does not have it.
        paired: whether the recorded units are those that were driven.
        resamples: of the bootstrap.
    """
    rivals = {name: each for name, each in others.items() if name not in FLOORS}
    ends = {**floors, **floors_of({name: each for name, each in others.items() if name in FLOORS}, recorded)}
    return {
        name: {
            "unit": UNITS[name],
            **_estimate("distance", distance(driven.counts[name], counts, paired, resamples)),
            "ceiling": ceiling(counts),
            "floor": ends.get("random", {}).get(name),
            "constant_velocity": ends.get("constant_velocity", {}).get(name),
            "samples": int(driven.counts[name].sum()),
            "recorded_samples": int(counts.sum()),
            "against": {
                rival: _against(driven.counts[name], each.counts[name], counts, paired, resamples)
                for rival, each in rivals.items()
            },
        }
        for name, counts in recorded.items()
    }


def floors_of(driven: Mapping[str, Driven], recorded: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Finite distances of the reference drivers to the recordings, by driver and quantity."""
    rows = {
        floor: {name: pooled_distance(driven[floor].counts[name], counts) for name, counts in recorded.items()}
        for floor in FLOORS
        if floor in driven
    }
    return {
        floor: {name: value for name, value in row.items() if math.isfinite(value)} for floor, row in rows.items()
    }


def _against(
    own: np.ndarray, other: np.ndarray, recorded: np.ndarray, paired: bool, resamples: int
) -> dict[str, Any]:
    """Another traffic's distance, and the difference to it."""
    theirs = distance(other, recorded, paired, resamples)
    difference = distance_difference(own, other, recorded, paired, resamples)
    return {**_estimate("distance", theirs), **_estimate("difference", difference), "verdict": verdict(difference)}


def verdict(difference: Estimate) -> str:
    """``closer`` or ``farther`` where the interval of the difference leaves out 0, else ``undecided``."""
    if not difference.excludes_zero():
        return "undecided"
    return "closer" if difference.value < 0.0 else "farther"


def _estimate(name: str, estimate: Estimate) -> dict[str, Any]:
    return {name: _finite(estimate.value), f"{name}_ci": estimate.interval}


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def driving_summary(driven: Mapping[str, Driven]) -> dict[str, Any]:
    """By traffic, lane changes per vehicle-km and the quantiles of every quantity."""
    return {
        name: {
            **rate(sum(each.measured.lane_changes.values()), sum(each.measured.vehicle_km.values())),
            "quantiles": quantiles_of(each.measured),
        }
        for name, each in driven.items()
    }


def card_checks(
    quantities: Mapping[str, Any],
    own: Mapping[str, Any],
    recorded: Mapping[str, Any],
    recorded_rate: Mapping[str, Any],
    spread_mps: float,
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The checks by name; None where the data to decide are missing.

    Args:
        quantities: the card's rows.
        own, recorded: quantiles of the traffic and of the recordings, from the same starts.
        recorded_rate: lane changes per vehicle-km with their interval.
        spread_mps: recorded mean spread of speeds within a frame.
        runs: the long runs.
    """
    rivals: dict[str, dict[str, str]] = {}
    for name in CLOSER_IN:
        for other, row in quantities[name]["against"].items():
            rivals.setdefault(other, {})[name] = row["verdict"]
    return {
        "compared_with": rivals,
        "acceleration_quantiles_within_30_percent": _quantiles_near(own, recorded),
        "long_runs": [_run_checks(run, recorded_rate, spread_mps) for run in runs],
    }


def _quantiles_near(own: Mapping[str, Any], recorded: Mapping[str, Any]) -> bool | None:
    pairs = [(own["acceleration"][level], recorded["acceleration"][level]) for level in ("0.05", "0.95")]
    if any(value is None for pair in pairs for value in pair):
        return None
    return all(abs(mine - theirs) <= _QUANTILE_SHARE * abs(theirs) for mine, theirs in pairs)


def _run_checks(run: Mapping[str, Any], recorded_rate: Mapping[str, Any], spread_mps: float) -> dict[str, Any]:
    changes, overlaps = run["lane_changes_per_vehicle_km"], run["overlaps_per_1000_vehicle_km"]
    recorded = recorded_rate["per_vehicle_km_ci"]
    spreads = [at["spread_mps"] for at in run["speeds"].values() if at["spread_mps"] is not None]
    wide = None if not spreads else min(spreads) >= 0.5 * spread_mps
    return {
        "vehicles": run["vehicles"],
        "lane_changes_inside_recorded_interval": _inside(changes, recorded),
        "overlaps_under_1_per_1000_vehicle_km": None if overlaps is None else overlaps < 1.0,
        "nobody_off_the_road": run["off_road"] == 0,
        "nobody_standing_in_free_flow": run["standstills_in_free_flow"] == 0,
        "spread_at_least_half_the_recorded": wide,
        "guard_under_5_percent": None if run["guard_share"] is None else run["guard_share"] < _MOST_GUARD,
    }


def _inside(value: float | None, interval: Sequence[float] | None) -> bool | None:
    return None if value is None or not interval else interval[0] <= value <= interval[1]
