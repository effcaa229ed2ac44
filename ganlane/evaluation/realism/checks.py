"""What a card is looked at for first, as plain yes, no, or undecided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

#: The quantities in which generated traffic is to come closer than rules do.
CLOSER_IN = ("speed_spread", "acceleration", "time_headway", "time_to_collision", "lane_change_duration")
#: How far a quantile of acceleration may be from the recorded one, as a share of it.
_QUANTILE_SHARE = 0.3
_MOST_GUARD = 0.05


def card_checks(
    quantities: Mapping[str, Any],
    own: Mapping[str, Any],
    recorded: Mapping[str, Any],
    recorded_rate: Mapping[str, Any],
    spread_mps: float,
    runs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The checks by name; null where nothing was driven that would tell.

    Args:
        quantities: the card's rows.
        own, recorded: quantiles seen from the starts.
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
        "acceleration_quantiles_within_30_percent": _near(own, recorded),
        "long_runs": [_run_checks(run, recorded_rate, spread_mps) for run in runs],
    }


def _near(own: Mapping[str, Any], recorded: Mapping[str, Any]) -> bool | None:
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
