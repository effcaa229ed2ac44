"""What the rows of ``suite=traffic`` say: the best of each traffic, and how the baselines compare."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from ganlane.benchmarks.case import Row

SYSTEM = "ganlane traffic"
SCENE_LOOP = "scene loop, pooling at every step"
SCENE_LOOP_ONCE = "scene loop, pooling once"
PADDED = "padded, 8 steps decoded"
#: Times the baseline that is asked of ``traffic=gan``.
REQUIRED = {SCENE_LOOP: 20.0, PADDED: 3.0}
#: Traffics that a network drives.
_GENERATED = ("gan", "gan_calibrated")
_KEPT = ("traffic", "system", "mode", "threads", "batch", "physics_steps_per_s", "physics_steps_per_cpu_s")


def best(rows: Iterable[Row], rate: str = "physics_steps_per_s") -> Row | None:
    """The fastest row, whatever its mode, threads and batch; None of none."""
    return max(rows, key=lambda row: row[rate], default=None)


def speeds(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The best row of each traffic and of each baseline."""
    found = (best(row for row in rows if _name(row) == name) for name in dict.fromkeys(map(_name, rows)))
    return [{key: row[key] for key in _KEPT} for row in found if row is not None]


def ratios(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Of each generated traffic to each baseline, both at their best: ``ratio`` (wall), ``ratio_cpu``, ``required``.

    The two ratios may come from different rows: one thread gives the most for its CPU time.
    """
    baselines = dict.fromkeys(row["system"] for row in rows if row["system"] != SYSTEM)
    return [
        {
            "traffic": traffic,
            "baseline": baseline,
            "ratio": _ratio(rows, traffic, baseline, "physics_steps_per_s"),
            "ratio_cpu": _ratio(rows, traffic, baseline, "physics_steps_per_cpu_s"),
            "required": REQUIRED.get(baseline) if traffic == "gan" else None,
        }
        for traffic in dict.fromkeys(row["traffic"] for row in rows if row["traffic"] in _GENERATED)
        for baseline in baselines
    ]


def _name(row: Row) -> tuple[str, str]:
    return row["system"], row["traffic"]


def _ratio(rows: Sequence[Row], traffic: str, baseline: str, rate: str) -> float:
    ours = best((row for row in rows if _name(row) == (SYSTEM, traffic)), rate)
    theirs = best((row for row in rows if row["system"] == baseline), rate)
    assert ours is not None
    assert theirs is not None
    return ours[rate] / theirs[rate]
