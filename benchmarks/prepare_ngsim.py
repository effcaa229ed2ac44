"""A made-up NGSIM portal file of full size (11.8 million rows, 1.2 GB) through ``ganlane prepare``:
time and memory.

    python benchmarks/prepare_ngsim.py --folder /tmp/ngsim
    python benchmarks/prepare_ngsim.py --folder /tmp/ngsim --rows 1000000

Writes the file, prepares it in a process of its own, prints seconds and peak resident memory, and
removes the file. Nothing in it was recorded: vehicles enter six lanes and drive 640 m at about 12
m/s, some change lanes. Places, periods, number formats and the order (whole tracks, periods mixed)
are those of the portal's file.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import polars as pl

#: Place, instant of frame 0 in ms, share of the rows.
PERIODS = (
    ("us-101", 1_118_846_978_900, 0.137),
    ("us-101", 1_118_847_842_000, 0.137),
    ("us-101", 1_118_848_742_000, 0.137),
    ("i-80", 1_113_433_134_100, 0.130),
    ("i-80", 1_113_436_734_100, 0.130),
    ("i-80", 1_113_437_634_100, 0.130),
    ("lankershim", 1_118_935_680_200, 0.110),
    ("peachtree", 1_163_030_500_000, 0.089),
)
ROAD_FT, LANES, LANE_FT, SECONDS, TRACK_ROWS = 2100.0, 6, 12.0, 900.0, 530
#: Vehicles written at once.
BATCH = 400


def tracks(
    place: str, start_ms: int, vehicles: np.ndarray, random: np.random.Generator
) -> pl.DataFrame:
    """Rows of some vehicles of one period."""
    n, k = len(vehicles), TRACK_ROWS
    time_s = 0.1 * np.arange(k)
    entry = random.integers(0, int(10 * (SECONDS - 60)), n)
    speed = random.normal(40.0, 4.0, n).clip(15.0, 60.0)
    swing = random.uniform(0.0, 2.0, n)[:, None]
    y = speed[:, None] * time_s + swing / 0.6 * np.sin(0.6 * time_s)
    lane = random.integers(1, LANES + 1, n)
    target = np.where(
        random.uniform(size=n) < 0.3, np.clip(lane + random.choice([-1, 1], n), 1, LANES), lane
    )
    done = np.clip((time_s - random.uniform(5.0, 40.0, n)[:, None]) / 4.0, 0.0, 1.0)
    share = 0.5 * (1.0 - np.cos(np.pi * done))
    x = LANE_FT * (lane[:, None] - 0.5 + (target - lane)[:, None] * share) + random.normal(
        0.0, 0.3, (n, k)
    )
    lanes = np.clip(np.ceil(x / LANE_FT), 1, LANES).astype(int)
    frame = entry[:, None] + np.arange(k)

    def each(values: np.ndarray) -> np.ndarray:
        return np.repeat(values, k)

    v = speed[:, None] + swing * 1.0 * np.cos(0.6 * time_s)
    numbers = {
        "vehicle_id": each(vehicles),
        "frame_id": frame.ravel(),
        "total_frames": each(np.full(n, k)),
        "global_time": (start_ms + 100 * frame).ravel(),
        "local_x": x.ravel().round(3),
        "local_y": y.ravel().round(3),
        "global_x": (6_042_842.0 + x).ravel().round(3),
        "global_y": (2_133_117.0 + y).ravel().round(3),
        "v_length": each(random.normal(15.0, 1.5, n).clip(8.0, 40.0).round(1)),
        "v_width": each(random.normal(6.5, 0.5, n).clip(4.0, 9.0).round(1)),
        "v_class": each(np.full(n, 2)),
        "v_vel": v.ravel().round(2),
        "v_acc": (-0.6 * swing * np.sin(0.6 * time_s)).ravel().round(2),
        "lane_id": lanes.ravel(),
    }
    empty = {
        name: pl.lit(None, pl.String)
        for name in ("o_zone", "d_zone", "int_id", "section_id", "direction")
    }
    last = {
        "preceding": 12,
        "following": 14,
        "space_headway": 61.55,
        "time_headway": 1.61,
        "location": place,
    }
    return pl.DataFrame(numbers).with_columns(
        **empty,
        movement=pl.lit(None, pl.String),
        **{name: pl.lit(value) for name, value in last.items()},
    )


def with_thousands(rows: pl.DataFrame) -> pl.DataFrame:
    """Times and places with commas between thousands, as the portal exports them."""
    time_ms = pl.col("global_time").cast(pl.String)
    grouped = [time_ms.str.slice(0, 1), *(time_ms.str.slice(at, 3) for at in (1, 4, 7, 10))]
    both = {}
    for name in ("global_x", "global_y"):
        text = pl.col(name).cast(pl.String)
        both[name] = pl.concat_str(
            [text.str.slice(0, 1), text.str.slice(1, 3), text.str.slice(4)], separator=","
        )
    return rows.with_columns(global_time=pl.concat_str(grouped, separator=","), **both)


def write(
    path: Path, rows: int, thousands: bool, periods: tuple[tuple[str, int, float], ...]
) -> int:
    """Write the file batch by batch, periods in turn; the rows written."""
    random = np.random.default_rng(0)
    whole = sum(share for *_, share in periods)
    counts = [max(1, round(rows * share / whole / TRACK_ROWS)) for *_, share in periods]
    batches = [
        (place, start, np.arange(first + 1, min(first + BATCH, count) + 1))
        for (place, start, _), count in zip(periods, counts)
        for first in range(0, count, BATCH)
    ]
    random.shuffle(batches)
    written = 0
    with path.open("wb") as file:
        for number, (place, start, vehicles) in enumerate(batches):
            table = tracks(place, start, vehicles, random)
            written += table.height
            (with_thousands(table) if thousands else table).write_csv(
                file, include_header=number == 0
            )
    return written


def main() -> None:
    """Make the file, prepare it, tell what it cost, remove it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--folder", type=Path, required=True, help="an empty or new folder with 5 GB of room"
    )
    parser.add_argument("--rows", type=int, default=11_800_000)
    parser.add_argument(
        "--one-period", action="store_true", help="all rows in one period (at most 5,000,000)"
    )
    parser.add_argument("--plain", action="store_true", help="no commas between thousands")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    path = options.folder / "ngsim.csv"
    run = options.folder / "run"
    try:
        begun = time.perf_counter()
        rows = write(
            path, options.rows, not options.plain, PERIODS[:1] if options.one_period else PERIODS
        )
        print(
            f"made {rows:,} rows, {path.stat().st_size / 1e9:.2f} GB in {time.perf_counter() - begun:.0f} s"
        )
        begun = time.perf_counter()
        command = [
            sys.executable,
            "-m",
            "ganlane.prepare",
            "data=ngsim",
            f"data.path={path}",
            f"hydra.run.dir={run}",
        ]
        subprocess.run(command, check=True)
        seconds = time.perf_counter() - begun
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        counted = json.loads((run / "results.json").read_text())["rows"]
        print(
            json.dumps(
                {"rows": counted, "wall_s": round(seconds, 1), "peak_rss_gib": round(peak, 2)}
            )
        )
    finally:
        path.unlink(missing_ok=True)
        shutil.rmtree(run, ignore_errors=True)


if __name__ == "__main__":
    main()
