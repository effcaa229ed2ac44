"""Convert recordings to one schema and report what they contain."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from ganlane.data.prepared import PooledStatistics, prepare_recordings
from ganlane.data.sources import byte_progress, recordings_path
from ganlane.data.statistics import describe
from ganlane.evaluation import write_results
from ganlane.evaluation.table import Table
from ganlane.files import write_bytes
from ganlane.runtime import peak_resident_bytes
from ganlane.settings.recordings import PrepareConfig
from ganlane.view.figures import save_figure
from ganlane.view.recordings import draw_recordings

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
    # The report says what reading and measuring cost.
    begun = time.perf_counter()
    source = recordings_path(config.data)
    # Without a place of their own the scenes lie in the run's folder.
    out = Path(config.out) if config.out else folder / "scenes"

    def show(scene: dict[str, Any]) -> None:  # while the others are still read
        line = f"{scene['name']}: {scene['rows']:,} rows, {scene['vehicle_km']:.1f} vehicle-km"
        print(line, file=sys.stderr, flush=True)

    with byte_progress("read") as progress:
        prepared = prepare_recordings(
            config.data.format,
            source,
            out,
            config.data.parameters(),
            config.scene_s,
            on_progress=progress,
            on_scene=show,
        )
    # The report embeds the figure by its name, so both can be moved together.
    sheet = save_figure(
        draw_recordings(prepared),
        folder / "report.png",
    )
    report = folder / "report.md"
    write_bytes(
        report,
        long_report(prepared, str(source), sheet.name).encode(),
    )
    print(f"{short_report(prepared)}\nscenes: {out}\nreport: {report}")
    # Some platforms do not tell it.
    peak = peak_resident_bytes()
    numbers = {
        "format": config.data.format,
        "source": str(source),
        "out": str(out),
        **prepared.to_dict(),
        "wall_s": time.perf_counter() - begun,
        "peak_memory_mb": None if peak is None else peak / 2**20,
    }
    return f"results: {write_results(folder, numbers, asdict(config), {})}"


def short_report(prepared: PooledStatistics) -> str:
    """Rows, exposure, lane-change rates and durations in a few lines."""
    exposure = prepared.exposure
    # What was read and dropped first: a wrong format shows there.
    lines = _row_lines(prepared)
    lines.append(
        f"driving: {exposure.scenes} scenes, {exposure.cars} cars, {exposure.tracks} tracks, "
        f"{exposure.vehicle_km:.1f} vehicle-km"
    )
    lines += [
        *_lane_change_lines(prepared),
        *_acceleration_lines(prepared),
    ]
    return "\n".join(lines)


def long_report(
    prepared: PooledStatistics,
    source: str,
    figure: str,
) -> str:
    """A page of Markdown about the recordings ``source``, with the image ``figure``."""
    # Each table with what it needs to be read.
    parts = [
        f"# Recordings: {source}",
        "## Rows",
        _bullets(_row_lines(prepared)),
        "## Scenes",
        _scene_table(prepared.scenes),
        "## Lane changes",
        _bullets(_lane_change_lines(prepared)),
        "Equation 9 takes every car to have driven the whole road; where tracks cover only part of "
        "it, it is too low, and the rate per driven kilometre is the one to use. A change that a "
        "track's end cuts off is censored: its time is a lower bound in Kaplan and Meier's "
        "estimate, and left out of the mean of the complete ones, which is too low, since long "
        "changes are cut off more often.",
        "## Distributions",
        _distribution_table(prepared),
        _bullets(_acceleration_lines(prepared)),
        "The headway is each follower's median of (gap - 2 m) / speed; the time headway is gap / "
        "speed of every row. Both count rows with a leader within 70 m at 2 m/s or more.",
        f"![Distributions]({figure})",
    ]
    return "\n\n".join(parts) + "\n"


def _row_lines(prepared: PooledStatistics) -> list[str]:
    count = prepared.count
    lines = [f"rows: {count.read:,} read, {count.kept:,} kept, {prepared.written:,} written"]
    return lines + [f"dropped: {rows:,} ({reason})" for reason, rows in count.dropped.most_common()]


def _lane_change_lines(prepared: PooledStatistics) -> list[str]:
    changes = prepared.lane_changes
    complete = changes.duration.complete
    duration = changes.duration
    lines = [
        f"lane changes: {changes.count:,}; {changes.srlc:.3f} per vehicle and km of road "
        f"(equation 9), {changes.per_vehicle_km:.3f} per driven vehicle-km (95 % interval "
        f"{changes.per_vehicle_km_low:.3f} to {changes.per_vehicle_km_high:.3f})"
    ]
    if duration.survival_mean_s is not None and complete.mean is not None:
        lines.append(
            f"their duration (equation 11): mean {duration.survival_mean_s:.2f} s by Kaplan and "
            f"Meier over {complete.count:,} complete and {duration.censored:,} censored ones; "
            f"{complete.mean:.2f} s over the complete ones alone"
        )
    # A mean needs one change that was seen from start to end.
    elif changes.count:
        unknown = f"unknown, all {duration.censored:,} are censored"
        lines.append(f"their duration (equation 11): {unknown}")
    return lines


def _acceleration_lines(prepared: PooledStatistics) -> list[str]:
    parts = []
    # Raw ones are mostly noise of the measurement; both are shown, so that this shows.
    for name, title in (
        ("raw", "as recorded"),
        ("smoothed", "over 1 s"),
    ):
        share = prepared.strong_share(f"acceleration_{name}")
        if share is not None:
            parts.append(f"{100.0 * share:.1f} % {title}")
    return [f"accelerations beyond 3 m/s2: {', '.join(parts)}"] if parts else []


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _scene_table(scenes: Sequence[dict[str, Any]]) -> str:
    # One line per scene.
    head = [
        "scene",
        "rows",
        "tracks",
        "s",
        "lanes",
        "lane width, m",
        "rows in the nearest lane, %",
        "vehicle-km",
        "mean speed, m/s",
        "lane changes",
        "per vehicle-km (95 %)",
    ]
    rows = []
    for scene in scenes:
        low, high = scene["per_vehicle_km_low"], scene["per_vehicle_km_high"]
        cells = [
            scene["name"],
            f"{scene['rows']:,}",
            f"{scene['tracks']:,}",
            f"{scene['seconds']:g}",
            f"{scene['lanes']}",
            f"{scene['lane_width_m']:.2f}",
            f"{100.0 * scene['nearest_lane_share']:.1f}",
            f"{scene['vehicle_km']:.1f}",
            f"{scene['mean_speed_mps']:.1f}",
            f"{scene['lane_changes']:,}",
            f"{scene['per_vehicle_km']:.3f} ({low:.3f} to {high:.3f})",
        ]
        rows.append(cells)
    return Table("", head, rows, len(head)).markdown(heading=False)


def _distribution_table(prepared: PooledStatistics) -> str:
    # A few of the stored levels.
    levels = [f"{100 * level:g} %" for level in _SHOWN_LEVELS]
    rows = []
    for name, title in _QUANTITIES.items():
        sample = describe(prepared.sample(name))
        # An empty sample leaves its cells empty.
        values = [sample.mean, sample.sd]
        values += [sample.quantile(level) if sample.count else None for level in _SHOWN_LEVELS]
        cells = ["" if value is None else f"{value:.2f}" for value in values]
        rows.append([title, f"{sample.count:,}", *cells])
    head = ["quantity", "samples", "mean", "sd", *levels]
    return Table("", head, rows, len(head)).markdown(heading=False)
