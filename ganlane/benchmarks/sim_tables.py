"""The rows and findings of ``suite=sim`` as tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ganlane.benchmarks.case import Row
from ganlane.benchmarks.tables import NOTHING, Table, count, percent, significant

#: Heading and cell of each column of the table of speeds; the first three are names.
COLUMNS: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("system", lambda row: row["system"]),
    ("mode", lambda row: row["mode"]),
    ("device", lambda row: row["device"]),
    ("threads", lambda row: str(row["threads"])),
    ("batch", lambda row: str(row["batch"])),
    ("physics steps/s", lambda row: count(row["physics_steps_per_s"])),
    ("decisions/s", lambda row: count(row["decisions_per_s"])),
    ("vehicle-steps/s", lambda row: count(row["vehicle_steps_per_s"])),
    ("physics steps/CPU-s", lambda row: count(row["physics_steps_per_cpu_s"])),
    ("times the peer", lambda row: significant(row["ratio"])),
    ("in CPU time", lambda row: significant(row["ratio_cpu"])),
    ("spread", lambda row: percent(row["spread"])),
    ("peak memory, MB", lambda row: NOTHING if row["peak_memory_mb"] is None else f"{row['peak_memory_mb']:.0f}"),
)
_SPREAD = "Medians; spread is the interquartile range of the repetitions' wall time over its median."


def sim_tables(rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
    """Speed, ratios (with a peer), growth, memory."""
    speed = [row for row in rows if row["part"] == "speed"]
    tables = [_speed(speed), _ratios(findings["ratios"]), _scaling(findings["scaling"]), _memory(findings["memory"])]
    return [table for table in tables if table.lines]


def _speed(rows: Sequence[Row]) -> Table:
    lines = [[cell(row) for _, cell in COLUMNS] for row in rows]
    where = f", {rows[0]['vehicles']} vehicles on {rows[0]['lanes']} lanes" if rows else ""
    return Table(f"Speed{where}", [heading for heading, _ in COLUMNS], lines, 3, [_SPREAD])


def _ratios(ratios: Sequence[Mapping[str, Any]]) -> Table:
    headings = ["what", "device", "row", "physics steps/s", "times the peer", "in CPU time", "asked for"]
    lines = [
        [
            ratio["what"],
            ratio["device"],
            f"{ratio['mode']}, threads {ratio['threads']}, batch {ratio['batch']}",
            count(ratio["physics_steps_per_s"]),
            significant(ratio["ratio"]),
            significant(ratio["ratio_cpu"]),
            str(ratio["required"]),
        ]
        for ratio in ratios
    ]
    peer = ratios[0]["peer"] if ratios else ""
    return Table(f"Against {peer}, physics steps per second", headings, lines, 3)


def _scaling(scaling: Sequence[Mapping[str, Any]]) -> Table:
    lines = [
        [
            growth["system"],
            growth["in"],
            ", ".join(map(str, growth["sizes"])),
            ", ".join(map(significant, growth["milliseconds"])),
            NOTHING if growth["exponent"] is None else f"{growth['exponent']:.2f}",
        ]
        for growth in scaling
    ]
    return Table("Growth of the cost", ["system", "with the", "sizes", "ms per decision", "exponent"], lines, 2)


def _memory(memory: Mapping[str, Any]) -> Table:
    """Per environment, in kB of 1000 bytes."""
    growth = memory["peak_growth_bytes"]
    batches = " and ".join(map(str, memory["batches"]))
    lines = [["state, observation included", f"{memory['state_bytes'] / 1000:.2f}"]]
    if growth is not None:
        lines.append([f"growth of a process's peak between batches {batches}", f"{growth / 1000:.2f}"])
    return Table(f"Memory per environment of {memory['vehicles']} vehicles", ["what", "kB"], lines, 1)
