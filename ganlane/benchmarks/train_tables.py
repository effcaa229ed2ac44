"""The rows and findings of ``suite=train`` as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ganlane.benchmarks.case import Row
from ganlane.benchmarks.tables import NOTHING, Table, count, percent, significant
from ganlane.benchmarks.train_shares import PARTS

_SPREAD = "Medians; spread is the interquartile range of the repetitions' wall time over its median."
_BEST = (
    "Each at its best mode, number of threads and number of environments. The minutes are those of the paper's "
    "schedule at this rate, without evaluations and checkpoints."
)
_APART = (
    "Wall time, in a repetition of its own with timers round the calls; what one part calls of another is counted "
    "with the other. Simulator: ego, physics, collisions, first scenes."
)
_LOSSES = "The first two: loss, backward pass and optimiser step on the same network and the same batch; eager."


def train_tables(rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
    """Verdicts, all rows, shares of the time, losses."""
    tables = [_speeds(findings["speeds"]), _rows(rows), _shares(findings["shares"]), _losses(findings["losses"])]
    return [table for table in tables if table.lines]


def _where(row: Mapping[str, Any]) -> str:
    return f"{row['mode']}, threads {row['threads']}, {row['batch']} environments"


def _speeds(speeds: Sequence[Mapping[str, Any]]) -> Table:
    lines = [
        [
            *(speed["traffic"], speed["device"], _where(speed), speed["verdict"] or NOTHING),
            count(speed["decisions_per_s"]),
            *(NOTHING if speed[key] is None else f"{speed[key]:.0f}" for key in ("must", "aim")),
            *(significant(speed["schedule_minutes"]), significant(speed["times_peer"])),
        ]
        for speed in speeds
    ]
    headings = ["traffic", "device", "row", "verdict", "decisions/s", "must", "aim", "minutes", "times the peer"]
    return Table("Decisions per second with learning", headings, lines, 4, [_BEST])


def _rows(rows: Sequence[Row]) -> Table:
    lines = [
        [
            *(row["system"], row["traffic"], row["mode"], row["device"], str(row["threads"]), str(row["batch"])),
            count(row["decisions_per_s"]),
            count(row["physics_steps_per_s"]),
            count(row["decisions"] / row["cpu_s"] if row["cpu_s"] else None),
            percent(row["spread"]),
        ]
        for row in rows
    ]
    names = ["system", "traffic", "mode", "device", "threads", "environments"]
    figures = ["decisions/s", "physics steps/s", "decisions/CPU-s", "spread"]
    where = f", {rows[0]['vehicles']} vehicles on {rows[0]['lanes']} lanes" if rows else ""
    return Table(f"Training in every mode{where}", [*names, *figures], lines, 4, [_SPREAD])


def _shares(shares: Sequence[Mapping[str, Any]]) -> Table:
    """One column per traffic; parts and, below them, what they consist of."""
    lines = []
    for part, details in PARTS.items():
        lines.append([part, "", *(percent(found["totals"][part]) for found in shares)])
        lines += [["", name, *(_fine(found["shares"].get(name, 0.0)) for found in shares)] for name in details]
    headings = ["part", "of which", *(f"{found['traffic']}, {found['device']}" for found in shares)]
    taken = [
        f"{found['traffic']}: {_where(found)}; {count(found['decisions_per_s'])} decisions/s with the timers."
        for found in shares
    ]
    return Table("Share of the time", headings, lines if shares else [], 2, [" ".join([_APART, *taken])])


def _fine(share: float) -> str:
    """With a tenth: the details are small."""
    return f"{100 * share:.1f} %"


def _losses(losses: Sequence[Mapping[str, Any]]) -> Table:
    lines = [
        [
            *(loss["system"], str(loss["threads"]), str(loss["batch_size"])),
            *(f"{loss[key]:.2f}" for key in ("milliseconds", "cpu_milliseconds")),
        ]
        for loss in losses
    ]
    return Table("Milliseconds per update", ["what", "threads", "batch size", "ms", "CPU-ms"], lines, 1, [_LOSSES])
