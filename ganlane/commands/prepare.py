"""Convert recordings to one schema and report what they contain."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from ganlane.settings.recordings import PrepareConfig
from ganlane.data import (
    Preparation,
    SceneSummary,
    byte_progress,
    prepare_recordings,
    recordings_path,
)
from ganlane.evaluation import write_results
from ganlane.evaluation.table import Table
from ganlane.files import write_bytes
from ganlane.runtime import peak_resident_bytes
from ganlane.view.figures import draw_recordings, save_figure

#: Maximum number of scenes in the table.
_MOST_SCENES: Final = 60
_QUANTITIES: Final = {
    "speed": "speed, m/s",
    "acceleration_raw": "acceleration as recorded, m/s2",
    "acceleration_smoothed": "acceleration over 1 s, m/s2",
    "headway": "followers' headway, s",
    "time_headway": "time headway, s",
    "gap": "gap to the leader, m",
}
_SHOWN_LEVELS: Final = (0.05, 0.25, 0.5, 0.75, 0.95)


def prepare(config: PrepareConfig, folder: Path) -> str:
    """Download where asked to, read, write, measure and report; the line that names the results."""
    begun = time.perf_counter()
    source, parameters = recordings_path(config.data), config.data.parameters()
    out = Path(config.out) if config.out else folder / "scenes"

    def show(scene: SceneSummary) -> None:  # while the others are still read
        print(
            f"{scene.name}: {scene.rows:,} rows, {scene.vehicle_km:.1f} vehicle-km",
            file=sys.stderr,
            flush=True,
        )

    with byte_progress("read") as progress:
        prepared = prepare_recordings(
            config.data.format, source, out, parameters, config.scene_s, progress, show
        )
    sheet = save_figure(draw_recordings(prepared.statistics), folder / "report.png")
    write_bytes(folder / "report.md", long_report(prepared, str(source), sheet.name).encode())
    print(f"{short_report(prepared)}\nscenes: {out}\nreport: {folder / 'report.md'}")
    peak = peak_resident_bytes()
    cost = {
        "wall_s": time.perf_counter() - begun,
        "peak_memory_mb": None if peak is None else peak / 2**20,
    }
    numbers = {
        "format": config.data.format,
        "source": str(source),
        "out": str(out),
        **prepared.to_dict(),
        **cost,
    }
    return f"results: {write_results(folder, numbers, asdict(config), {})}"


def short_report(prepared: Preparation) -> str:
    """Rows, exposure, lane-change rates and durations in a few lines."""
    exposure = prepared.statistics.exposure
    driving = (
        f"driving: {exposure.scenes} scenes, {exposure.cars} cars, {exposure.tracks} tracks, "
        f"{exposure.vehicle_km:.1f} vehicle-km"
    )
    lines = [
        *_row_lines(prepared),
        driving,
        *_lane_change_lines(prepared),
        *_acceleration_lines(prepared),
    ]
    return "\n".join(lines)


def long_report(prepared: Preparation, source: str, figure: str) -> str:
    """A page of Markdown about the recordings ``source``, with the image ``figure``."""
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
        lines.append(
            f"their duration (equation 11): unknown, all {duration.censored:,} are censored"
        )
    return lines


def _acceleration_lines(prepared: Preparation) -> list[str]:
    statistics = prepared.statistics
    titles = {"acceleration_raw": "as recorded", "acceleration_smoothed": "over 1 s"}
    shares = {title: statistics.strong_share(name) for name, title in titles.items()}
    parts = [
        f"{100.0 * share:.1f} % {title}" for title, share in shares.items() if share is not None
    ]
    return [f"accelerations beyond 3 m/s2: {', '.join(parts)}"] if parts else []


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _scene_table(scenes: Sequence[SceneSummary]) -> str:
    head = [
        *(
            "scene",
            "rows",
            "tracks",
            "s",
            "lanes",
            "lane width, m",
            "rows in the nearest lane, %",
            "vehicle-km",
        ),
        *("mean speed, m/s", "lane changes", "per vehicle-km (95 %)"),
    ]
    rows = [
        [
            *(
                each.name,
                f"{each.rows:,}",
                f"{each.tracks:,}",
                f"{each.seconds:g}",
                f"{each.lanes}",
            ),
            *(
                f"{each.lane_width_m:.2f}",
                f"{100.0 * each.nearest_lane_share:.1f}",
                f"{each.vehicle_km:.1f}",
            ),
            *(f"{each.mean_speed_mps:.1f}", f"{each.lane_changes:,}"),
            f"{each.per_vehicle_km:.3f} ({each.per_vehicle_km_low:.3f} to {each.per_vehicle_km_high:.3f})",
        ]
        for each in scenes[:_MOST_SCENES]
    ]
    more = len(scenes) - _MOST_SCENES
    return Table("", head, rows, len(head)).markdown(heading=False) + (
        f"\n\n{more} more scenes are in results.json." if more > 0 else ""
    )


def _distribution_table(prepared: Preparation) -> str:
    head = ["quantity", "samples", "mean", "sd", *(f"{100 * level:g} %" for level in _SHOWN_LEVELS)]
    rows = []
    for name, title in _QUANTITIES.items():
        found = prepared.statistics.describe(name)
        quantiles = [found.quantile(level) if found.count else None for level in _SHOWN_LEVELS]
        numbers = [
            "" if value is None else f"{value:.2f}" for value in (found.mean, found.sd, *quantiles)
        ]
        rows.append([title, f"{found.count:,}", *numbers])
    return Table("", head, rows, len(head)).markdown(heading=False)
