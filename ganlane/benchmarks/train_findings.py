"""What the rows of ``suite=train`` say: the best of each traffic, beside what is asked of it and beside the peer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ganlane.benchmarks.case import Row

SYSTEM = "ganlane training"
AIM, MUST, MISSED = "aim reached", "must reached", "missed"


class Target(NamedTuple):
    """Decisions/s that are asked for, with learning, on two cores; ``schedule`` is how many the paper makes."""

    must: float
    aim: float
    schedule: int


#: Traffic to what is asked of it, at one update of batch 256 per 64 decisions.
TARGETS = {"idm_mobil": Target(5000, 8000, 10_000_000), "gan": Target(800, 1500, 3_000_000)}
_BATCH_SIZE, _PER_UPDATE = 256, 64
_KEPT = ("traffic", "device", "mode", "threads", "batch", "decisions_per_s")


def best(rows: Iterable[Row]) -> Row | None:
    """The row with the most decisions per second; None of none."""
    return max(rows, key=lambda row: row["decisions_per_s"], default=None)


def best_rows(rows: Sequence[Row]) -> list[Row]:
    """The best row of each traffic on each device."""
    places = dict.fromkeys((row["device"], row["traffic"]) for row in rows if row["system"] == SYSTEM)
    found = (
        best(row for row in rows if (row["system"], row["device"], row["traffic"]) == (SYSTEM, *place))
        for place in places
    )
    return [row for row in found if row is not None]


def speeds(rows: Sequence[Row], batch_size: int, decisions_per_update: int) -> list[dict[str, Any]]:
    """Per device and traffic the best row, with ``must``, ``aim``, ``verdict`` and ``schedule_minutes``.

    The four are None where nothing is asked: other traffic, other learning than one update of batch 256 per 64
    decisions, or a GPU. ``times_peer`` is the ratio of the medians of decisions per second, both at their best.
    """
    peer = best(row for row in rows if row["system"] != SYSTEM)
    usual = (batch_size, decisions_per_update) == (_BATCH_SIZE, _PER_UPDATE)
    return [
        {
            **{key: row[key] for key in _KEPT},
            "updates_per_s": row["decisions_per_s"] / decisions_per_update,
            **_judged(row["decisions_per_s"], TARGETS.get(row["traffic"]) if usual else None, row["device"]),
            "times_peer": None if peer is None else row["decisions_per_s"] / peer["decisions_per_s"],
        }
        for row in best_rows(rows)
    ]


def _judged(rate: float, target: Target | None, device: str) -> dict[str, Any]:
    if target is None or device != "cpu":
        return dict.fromkeys(("must", "aim", "verdict", "schedule", "schedule_minutes"))
    verdict = AIM if rate >= target.aim else MUST if rate >= target.must else MISSED
    minutes = target.schedule / rate / 60
    return {**target._asdict(), "verdict": verdict, "schedule_minutes": minutes}
