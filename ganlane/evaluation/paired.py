"""Who drives better on the same episodes: paired leads of one driver over others."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import polars as pl

from ganlane.evaluation.statistics import Estimate, paired_difference

Row = dict[str, Any]
Verdict = Literal["above", "below", "undecided"]

#: What two drivers' episodes are matched by.
EPISODE = ["seed", "episode"]


def paired_rewards(*drivers: pl.DataFrame) -> list[npt.NDArray[np.float64]]:
    """The returns of each of ``drivers`` on the episodes that all of them drove, in one order, each [E] float64."""
    shared = drivers[0].select(EPISODE)
    for number, driver in enumerate(drivers):
        shared = shared.join(driver.select(*EPISODE, pl.col("reward").alias(str(number))), on=EPISODE)
    ordered = shared.sort(EPISODE)
    return [ordered[str(number)].cast(pl.Float64).to_numpy() for number in range(len(drivers))]


def paired_lead(driver: pl.DataFrame, other: pl.DataFrame) -> tuple[Estimate | None, int]:
    """Mean return of ``driver`` minus that of ``other``, and the number of episodes that both drove.

    The interval is the bootstrap's over the differences (BCa, 95 %); no estimate for fewer than two episodes.
    """
    first, second = paired_rewards(driver, other)
    return (paired_difference(first, second) if len(first) > 1 else None), len(first)


def verdict(lead: Estimate) -> Verdict:
    """``above`` or ``below`` where the interval lies wholly on one side of 0, else ``undecided``."""
    if not lead.excludes_zero():
        return "undecided"
    return "above" if lead.value > 0.0 else "below"


def paired_rows(episodes: pl.DataFrame) -> list[Row]:
    """The first driver against each of the others, traffic by traffic.

    Args:
        episodes: as :func:`ganlane.evaluation.evaluation_rows` takes them.

    Returns:
        Per traffic and other driver ``agent, over, traffic, episodes`` (driven by both), ``lead`` (mean return of
        ``agent`` minus that of ``over``), ``lead_ci`` (95 %) and ``verdict`` (:func:`verdict`). Pairs that share
        fewer than two episodes are left out.
    """
    first, rows = episodes["agent"][0], []
    for (traffic,), there in episodes.group_by("traffic", maintain_order=True):
        own = there.filter(pl.col("agent") == first)
        for (other,), driven in there.group_by("agent", maintain_order=True):
            lead, shared = paired_lead(own, driven) if other != first else (None, 0)
            if lead is not None:
                row = {"agent": first, "over": other, "traffic": traffic, "episodes": shared}
                rows.append({**row, "lead": lead.value, "lead_ci": lead.interval, "verdict": verdict(lead)})
    return rows
