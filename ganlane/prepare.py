"""``ganlane prepare``: recordings of any kind into one schema, as Parquet, with a report of what they show.

    ganlane prepare data=scenes data.path=recordings.csv
    ganlane prepare data=ngsim data.path=trajectories-0750am-0805am.txt out=us101
    ganlane prepare data=ngsim data.path=ngsim.csv data.download=true scene_s=30
    ganlane prepare data=highd data.path=highD/data
    ganlane train_generator data.path=us101

Writes one Parquet file per recording, report.md, report.png and results.json.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from ganlane.config.app import run_command
from ganlane.config.recordings import PrepareConfig

if TYPE_CHECKING:
    from ganlane.data import SceneSummary


def prepare(config: PrepareConfig, folder: Path) -> str:
    """Fetch where asked to, read, write, measure, report."""
    from ganlane.data import ByteProgress, default_scenes, download, long_report, prepare_recordings, short_report
    from ganlane.evaluation import write_results
    from ganlane.files import write_bytes
    from ganlane.parameters.data import NgsimDataConfig
    from ganlane.view.figures import draw_recordings, save_figure

    begun = time.perf_counter()
    source = Path(config.data.path) if config.data.path else default_scenes()
    parameters = config.data.parameters()
    if isinstance(config.data, NgsimDataConfig) and config.data.download:
        with ByteProgress("download") as progress:
            download(config.data.url, source, config.data.sha256, progress)
    out = Path(config.out) if config.out else folder / "scenes"
    with ByteProgress("read") as progress:
        prepared = prepare_recordings(config.data.format, source, out, parameters, config.scene_s, progress, _show)
    sheet = save_figure(draw_recordings(prepared.statistics), folder / "report.png")
    write_bytes(folder / "report.md", long_report(prepared, str(source), sheet.name).encode())
    print(f"{short_report(prepared)}\nscenes: {out}\nreport: {folder / 'report.md'}")
    cost = {"wall_s": time.perf_counter() - begun, "peak_memory_mb": _peak_memory_mb()}
    numbers = {"format": config.data.format, "source": str(source), "out": str(out), **prepared.to_dict(), **cost}
    return f"results: {write_results(folder, numbers, asdict(config), {})}"


def _show(scene: SceneSummary) -> None:
    """A line per recording while the work goes on."""
    print(f"{scene.name}: {scene.rows:,} rows, {scene.vehicle_km:.1f} vehicle-km", file=sys.stderr, flush=True)


def _peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far; None where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    return run_command("prepare", prepare, arguments)


if __name__ == "__main__":
    sys.exit(main())
