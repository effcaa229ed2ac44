"""What the rows of ``suite=sim`` say: ratios to the peer, and how cost grows with the batch and with the vehicles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ganlane.benchmarks.case import EAGER, Row
from ganlane.benchmarks.rows import exponent

PHYSICS = "ganlane physics"
ENVIRONMENT = "ganlane environment"


class Target(NamedTuple):
    """A comparison with the peer: which rows compete, and the ratio that is asked for."""

    what: str
    system: str
    required: float
    #: Only eager rows of one environment compete, rather than all.
    alone: bool = False


TARGETS = (
    Target("bare physics, best batch", PHYSICS, 1000),
    Target("whole environment, best batch", ENVIRONMENT, 500),
    Target("whole environment, batch 1, eager", ENVIRONMENT, 1, alone=True),
)


def ratios(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Per target and device the best row: ``what, device, mode, threads, batch, peer, physics_steps_per_s, ratio,
    ratio_cpu, required``; empty without a peer."""
    peer = next((row for row in rows if row["system"] not in (PHYSICS, ENVIRONMENT)), None)
    if peer is None:
        return []
    devices = dict.fromkeys(row["device"] for row in rows)
    found = (_ratio(target, device, rows, peer["system"]) for device in devices for target in TARGETS)
    return [ratio for ratio in found if ratio is not None]


def _ratio(target: Target, device: str, rows: Iterable[Row], peer: str) -> dict[str, Any] | None:
    """The best of the rows that compete."""
    competing = [
        row
        for row in rows
        if row["part"] == "speed"
        and (row["system"], row["device"]) == (target.system, device)
        and (not target.alone or (row["batch"], row["mode"]) == (1, EAGER))
    ]
    if not competing:
        return None
    best = max(competing, key=lambda row: row["ratio"])
    kept = ("device", "mode", "threads", "batch", "physics_steps_per_s", "ratio", "ratio_cpu")
    return {"what": target.what, "peer": peer, **{key: best[key] for key in kept}, "required": target.required}


def scaling(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Per system ``exponent`` of the cost of a decision in the batch (1: linear) and in the number of vehicles.

    Each with the ``sizes`` and the ``milliseconds`` of wall time that a decision of the whole batch took there.
    """
    found = []
    for part in ("batch", "vehicles"):
        for system in (PHYSICS, ENVIRONMENT):
            chosen = [row for row in rows if (row["part"], row["system"]) == (part, system)]
            if chosen:
                found.append({"in": part, "system": system, **_growth(chosen, part)})
    return found


def _growth(rows: Sequence[Row], part: str) -> dict[str, Any]:
    sizes = [row[part] for row in rows]
    milliseconds = [1000 * row["wall_s"] / (row["decisions"] / row["batch"]) for row in rows]
    return {"sizes": sizes, "milliseconds": milliseconds, "exponent": exponent(sizes, milliseconds)}
