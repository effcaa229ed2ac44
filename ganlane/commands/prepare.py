"""Convert recordings to one schema and report what they contain."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from ganlane.data.prepared import PooledStatistics, prepare_recordings
from ganlane.data.sources import byte_progress, recordings_path
from ganlane.evaluation import write_results
from ganlane.settings.recordings import PrepareConfig


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
    print(f"{short_report(prepared)}\nscenes: {out}")
    numbers = {
        "format": config.data.format,
        "source": str(source),
        "out": str(out),
        **prepared.to_dict(),
        "wall_s": time.perf_counter() - begun,
    }
    return f"results: {write_results(folder, numbers, config, {})}"


def short_report(prepared: PooledStatistics) -> str:
    """Rows, exposure, lane-change rates and durations in a few lines."""
    exposure = prepared.exposure
    count = prepared.count
    # What was read and dropped first: a wrong format shows there.
    lines = [f"rows: {count.read:,} read, {count.kept:,} kept, {prepared.written:,} written"]
    lines += [f"dropped: {rows:,} ({reason})" for reason, rows in count.dropped.most_common()]
    lines.append(
        f"driving: {exposure.scenes} scenes, {exposure.cars} cars, {exposure.tracks} tracks, "
        f"{exposure.vehicle_km:.1f} vehicle-km"
    )
    lines += [*_lane_change_lines(prepared), *_acceleration_lines(prepared)]
    return "\n".join(lines)


def _lane_change_lines(prepared: PooledStatistics) -> list[str]:
    """Their rates, and their duration where it is known."""
    changes = prepared.lane_changes
    duration = changes.duration
    complete = duration.complete
    lines = [
        f"lane changes: {changes.count:,}; {changes.srlc:.3f} per vehicle and km of road "
        f"(equation 9), {changes.per_vehicle_km:.3f} per driven vehicle-km (95 % interval "
        f"{changes.per_vehicle_km_low:.3f} to {changes.per_vehicle_km_high:.3f})"
    ]
    if complete.count:
        lines.append(
            f"their duration (equation 11): mean {duration.survival_mean_s:.2f} s by Kaplan and "
            f"Meier over {complete.count:,} complete and {duration.censored:,} censored ones; "
            f"{complete.mean:.2f} s over the complete ones alone"
        )
    # A mean needs one change that was seen from start to end.
    elif changes.count:
        lines.append(
            f"their duration (equation 11): unknown, all {duration.censored:,} are censored"
        )
    return lines


def _acceleration_lines(prepared: PooledStatistics) -> list[str]:
    """Share of strong accelerations; no line without any acceleration."""
    parts = []
    # Raw ones are mostly noise of the measurement; both are shown, so that this shows.
    for name, title in (("raw", "as recorded"), ("smoothed", "over 1 s")):
        share = prepared.strong_share(f"acceleration_{name}")
        if share is not None:
            parts.append(f"{100.0 * share:.1f} % {title}")
    return [f"accelerations beyond 3 m/s2: {', '.join(parts)}"] if parts else []
