"""The numbers of all variants for a reader."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from benchmarks.ablations.variants import Variant

HEADINGS = (
    "variant",
    "vehicle-km",
    "lane changes per vehicle-km",
    "overlaps per 1000 vehicle-km [95 %]",
    "off road",
    "mean speed, m/s",
    "spread, m/s",
    "acceleration 5 %, 95 %, m/s²",
    "the guard's share",
    "physics steps/CPU-s",
)


def cells(numbers: dict[str, Any]) -> list[str]:
    """A row of the table behind its name."""
    changes, overlaps = numbers["lane_changes_per_vehicle_km"], numbers["overlaps_per_1000_vehicle_km"]
    low, high = numbers["overlaps_per_1000_vehicle_km_ci"] or (0.0, math.inf)
    slow, fast = numbers["acceleration_quantiles"].values()
    share = numbers["guard_share"]
    return [
        f"{numbers['vehicle_km']:.0f}",
        "-" if changes is None else f"{changes:.2f}",
        "-" if overlaps is None else f"{overlaps:.1f} [{low:.1f}, {high:.1f}]",
        str(numbers["off_road"]),
        f"{numbers['mean_speed_mps']:.1f}",
        f"{numbers['spread_mps']:.2f}",
        f"{slow:.2f}, {fast:.2f}",
        "-" if share is None else f"{100 * share:.1f} %",
        f"{numbers['physics_steps_per_cpu_s'] / 1000:.1f} k",
    ]


def table(rows: Sequence[tuple[Variant, dict[str, Any]]]) -> str:
    """Markdown: the variants of each preset under its name."""
    lines = [HEADINGS, ("---", *["---:"] * (len(HEADINGS) - 1))]
    text = [f"| {' | '.join(line)} |" for line in lines]
    text += [f"| {' | '.join([f'`{v.preset}`, {v.name}', *cells(numbers)])} |" for v, numbers in rows]
    return "\n".join(text)
