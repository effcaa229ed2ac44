"""``ganlane evaluate``: agents on traffics, as one table; the quick form on any traffic."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from ganlane import evaluation
from ganlane.build import make_drivers
from ganlane.evaluation.results import seeds_of
from ganlane.evaluation.statistics import entries
from ganlane.evaluation.table import show
from ganlane.settings.commands import EvaluateConfig, RunConfig
from ganlane.suite.driving import compare


def evaluate(config: EvaluateConfig, folder: Path) -> str:
    """Run the episodes, print and save the table.

    The line that names the results.
    """
    drivers = make_drivers(config.agents, config.env, config.device)
    table = compare(drivers, config)
    return publish(table, folder, config, seeds_of(config))


def recorded_crashes(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Crashes per km of each agent on each traffic that replays recorded scenes.

    Returns:
        Per pair ``agent, traffic, per_km, per_km_ci`` (bootstrap over whole scenes) and ``scenes``,
        see :func:`ganlane.evaluation.crashes_by_scene`; nothing for other traffics.
    """
    if "scene" not in table.columns:
        return []
    rows = []
    # Generated and rule-driven traffics have no scenes to resample.
    recorded = table.filter(pl.col("scene").is_not_null())
    for (agent, traffic), episodes in recorded.group_by("agent", "traffic", maintain_order=True):
        per_km, scenes = evaluation.crashes_by_scene(episodes, episodes["scene"].to_list())
        rows.append(
            {
                "agent": agent,
                "traffic": traffic,
                **entries("per_km", per_km),
                "scenes": scenes,
            }
        )
    return rows


def publish(
    table: pl.DataFrame,
    folder: Path,
    config: RunConfig,
    seeds: Mapping[str, Any],
    numbers: Mapping[str, Any] | None = None,
) -> str:
    """Print the tables of what :func:`compare` gave, save its episodes and numbers.

    ``results.json`` holds ``rows``, ``paired`` (:func:`ganlane.evaluation.paired_rows`; a second
    table with two drivers or more), ``failures`` (:func:`ganlane.evaluation.failed_episodes`),
    ``crashes_by_scene`` where a traffic replays recorded scenes (:func:`recorded_crashes`), and
    further ``numbers``.

    Args:
        table: the episodes.
        folder: of the run, in which the files are written.
        config: of the command; its ``columns`` are those of the tables.
        seeds: which episodes they were, for ``results.json``.
        numbers: further ones.

    Returns:
        The line that names ``results.json``.
    """
    # On the same episodes a difference shows long before two intervals part.
    rows = evaluation.evaluation_rows(table)
    paired = evaluation.paired_rows(table)
    tables = [evaluation.text_table(rows)]
    # A driver alone has nobody to be paired with.
    if paired:
        tables.append(evaluation.paired_table(paired))
    show(*tables, columns=config.columns)

    record: dict[str, Any] = {"rows": rows, "paired": paired}
    recorded = recorded_crashes(table)
    if recorded:
        record["crashes_by_scene"] = recorded
    record |= {"failures": evaluation.failed_episodes(table), **(numbers or {})}
    evaluation.write_episodes(folder, table)
    return f"results: {evaluation.write_results(folder, record, config, seeds)}"
