"""What was prepared, as text: a few lines for the terminal, and a page of Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from ganlane.data.distributions import Distribution
from ganlane.data.preparation import Preparation
from ganlane.data.scene_summary import SceneSummary

#: A page lists no more scenes than this one by one.
MOST_SCENES: Final = 60
_QUANTITIES: Final = {
    "speed": "speed, m/s",
    "acceleration_raw": "acceleration as recorded, m/s2",
    "acceleration_smoothed": "acceleration over 1 s, m/s2",
    "headway": "followers' headway, s",
    "time_headway": "time headway, s",
    "gap": "gap to the leader, m",
}
_SHOWN_LEVELS: Final = (0.05, 0.25, 0.5, 0.75, 0.95)


def short_report(prepared: Preparation) -> str:
    """Rows, amount of driving, lane-change rates and durations in a few lines."""
    exposure = prepared.statistics.exposure
    return "\n".join(
        [
            *_row_lines(prepared),
            f"driving: {exposure.scenes} scenes, {exposure.cars} cars, {exposure.tracks} tracks, "
            f"{exposure.vehicle_km:.1f} vehicle-km",
            *_lane_change_lines(prepared),
            *_acceleration_lines(prepared),
        ]
    )


def long_report(prepared: Preparation, source: str, figure: str) -> str:
    """The page: ``source`` is what was read, ``figure`` the name of the sheet of figures beside it."""
    parts = [
        f"# Recordings: {source}",
        "## Rows\n\n" + _bullets(_row_lines(prepared)),
        "## Scenes\n\n" + _scene_table(prepared.statistics.scenes),
        "## Lane changes\n\n" + _bullets(_lane_change_lines(prepared)),
        "Equation 9 takes every car to have driven the whole road; where tracks cover only part of it, it is too "
        "low, and the rate per driven kilometre is the one to use. A change that a track's end cuts off is censored: "
        "its time is a lower bound in Kaplan and Meier's estimate, and left out of the mean of the complete ones, "
        "which is too low, since long changes are cut off more often.",
        "## Distributions\n\n" + _distribution_table(prepared),
        _bullets(_acceleration_lines(prepared)),
        "The headway is each follower's median of (gap - 2 m) / speed; the time headway is gap / speed of every row. "
        "Both count rows with a leader within 70 m at 2 m/s or more.",
        f"![Distributions]({figure})",
    ]
    return "\n\n".join(parts) + "\n"


def _row_lines(prepared: Preparation) -> list[str]:
    count = prepared.count
    lines = [f"rows: {count.read:,} read, {count.kept:,} kept, {prepared.written:,} written"]
    return lines + [f"dropped: {rows:,} ({reason})" for reason, rows in count.dropped.most_common()]


def _lane_change_lines(prepared: Preparation) -> list[str]:
    found = prepared.statistics.lane_changes
    complete, duration = found.duration.complete, found.duration
    interval = f"95 % interval {found.per_vehicle_km_low:.3f} to {found.per_vehicle_km_high:.3f}"
    lines = [
        f"lane changes: {found.count:,}; {found.srlc:.3f} per vehicle and km of road (equation 9), "
        f"{found.per_vehicle_km:.3f} per driven vehicle-km ({interval})"
    ]
    if duration.survival_mean_s is not None and complete.mean is not None:
        lines.append(
            f"their duration (equation 11): mean {duration.survival_mean_s:.2f} s by Kaplan and Meier over "
            f"{complete.count:,} complete and {duration.censored:,} censored ones; "
            f"{complete.mean:.2f} s over the complete ones alone"
        )
    elif found.count:
        lines.append(f"their duration (equation 11): unknown, all {duration.censored:,} are censored")
    return lines


def _acceleration_lines(prepared: Preparation) -> list[str]:
    statistics = prepared.statistics
    shares = {name: statistics.strong_share(name) for name in ("acceleration_raw", "acceleration_smoothed")}
    words = {"acceleration_raw": "as recorded", "acceleration_smoothed": "over 1 s"}
    told = [f"{100.0 * share:.1f} % {words[name]}" for name, share in shares.items() if share is not None]
    return [f"accelerations beyond 3 m/s2: {', '.join(told)}"] if told else []


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    body = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(body)


def _scene_table(scenes: Sequence[SceneSummary]) -> str:
    head = [
        *("scene", "rows", "tracks", "s", "lanes", "lane width, m", "rows in the nearest lane, %", "vehicle-km"),
        *("mean speed, m/s", "lane changes", "per vehicle-km (95 %)"),
    ]
    rows = [
        [
            *(each.name, f"{each.rows:,}", f"{each.tracks:,}", f"{each.seconds:g}", f"{each.lanes}"),
            *(f"{each.lane_width_m:.2f}", f"{100.0 * each.nearest_lane_share:.1f}", f"{each.vehicle_km:.1f}"),
            *(f"{each.mean_speed_mps:.1f}", f"{each.lane_changes:,}"),
            f"{each.per_vehicle_km:.3f} ({each.per_vehicle_km_low:.3f} to {each.per_vehicle_km_high:.3f})",
        ]
        for each in scenes[:MOST_SCENES]
    ]
    more = len(scenes) - MOST_SCENES
    return _table(head, rows) + (f"\n\n{more} more scenes are in results.json." if more > 0 else "")


def _distribution_table(prepared: Preparation) -> str:
    head = ["quantity", "samples", "mean", "sd", *(f"{100 * level:g} %" for level in _SHOWN_LEVELS)]
    described = {name: prepared.statistics.describe(name) for name in _QUANTITIES}
    return _table(head, [_distribution_row(_QUANTITIES[name], each) for name, each in described.items()])


def _distribution_row(name: str, found: Distribution) -> list[str]:
    quantiles = [found.quantile(level) if found.count else None for level in _SHOWN_LEVELS]
    shown = ["" if value is None else f"{value:.2f}" for value in (found.mean, found.sd, *quantiles)]
    return [name, f"{found.count:,}", *shown]
