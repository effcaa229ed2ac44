"""The rows and findings of ``suite=traffic`` as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ganlane.benchmarks.case import Row
from ganlane.benchmarks.tables import NOTHING, Table, count, percent, significant

_HEADINGS = (
    *("system", "traffic", "mode", "threads", "batch"),
    *("physics steps/s", "vehicle-steps/s", "physics steps/CPU-s", "spread"),
)
_SPREAD = "Medians; spread is the interquartile range of the repetitions' wall time over its median."
_BEST = "Both at their best mode, batch and number of threads, for wall time and for CPU time each."


def traffic_tables(rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
    """All rows, then the ratios to the baselines, if there are any."""
    tables = [_speed(rows), _ratios(findings["ratios"])]
    return [table for table in tables if table.lines]


def _speed(rows: Sequence[Row]) -> Table:
    lines = [
        [
            *(row["system"], row["traffic"], row["mode"], str(row["threads"]), str(row["batch"])),
            count(row["physics_steps_per_s"]),
            count(row["vehicle_steps_per_s"]),
            count(row["physics_steps_per_cpu_s"]),
            percent(row["spread"]),
        ]
        for row in rows
    ]
    where = f", {rows[0]['vehicles']} vehicles on {rows[0]['lanes']} lanes, float32" if rows else ""
    return Table(f"Speed of the traffic{where}", _HEADINGS, lines, 3, [_SPREAD])


def _ratios(ratios: Sequence[Mapping[str, Any]]) -> Table:
    lines = [
        [
            *(ratio["traffic"], ratio["baseline"]),
            *(significant(ratio["ratio"]), significant(ratio["ratio_cpu"])),
            NOTHING if ratio["required"] is None else f"{ratio['required']:.0f}",
        ]
        for ratio in ratios
    ]
    headings = ["traffic", "baseline", "times the baseline", "in CPU time", "asked for"]
    return Table("Against Social-GANs without this package's means", headings, lines, 2, [_BEST])
