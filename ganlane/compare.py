"""Compare drivers: each one on each traffic, on the same episodes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
from tqdm import tqdm

from ganlane import evaluation
from ganlane.build import Driver, make_drivers, make_env, make_traffic
from ganlane.evaluation.statistics import entries
from ganlane.evaluation.table import show
from ganlane.settings.commands import EvaluateConfig
from ganlane.sim.random import Stream
from ganlane.torch_settings import set_threads
from ganlane.traffic import ReplayTraffic


def evaluate(config: EvaluateConfig, folder: Path) -> str:
    """``ganlane evaluate``: run the episodes, print and save the table.

    The line that names the results.
    """
    set_threads(config.threads)
    table = compare(make_drivers(config.agents, config.env, config.device), config)
    seeds = {
        "stream": config.stream,
        "seed": config.seed,
        "episodes": [0, config.episodes - 1],
    }
    return publish(
        table,
        folder,
        asdict(config),
        seeds,
    )


def compare(
    drivers: Sequence[Driver],
    config: EvaluateConfig,
    quiet: bool = False,
) -> pl.DataFrame:
    """Run the episodes of ``config`` with each driver on each of its traffics.

    Each of ``drivers`` (:func:`ganlane.build.make_driver`) drives with its own observation and
    mask, or with those of ``config`` if it names none; the sensors are those of ``config`` for all.
    ``quiet`` shows no progress.

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one
        below the other; and with ``scene``, the recorded scene of an episode, where one of the
        traffics replays (null for the others).
    """
    env = config.env
    seed = config.seed
    episodes = config.episodes
    stream = Stream.named(config.stream)
    # All traffics are made first, so that one that cannot be made shows before any driving.
    modules = {name: make_traffic(option, env, stream) for name, option in config.traffics.items()}
    total = len(modules) * len(drivers) * episodes
    # One table per driver and traffic, concatenated at the end; current is what the environment at
    # hand was built for.
    tables = []
    current = None
    disabled = quiet or not sys.stderr.isatty()
    with tqdm(
        total=total,
        unit="episode",
        file=sys.stderr,
        disable=disabled,
    ) as bar:
        for traffic, module in modules.items():
            for driver in drivers:
                observation = config.observation.read_by(driver.observation)
                mask, policy = driver.behind(config.mask)
                # All but the number of rows, which shrinks towards the end.
                make = partial(
                    make_env,
                    module,
                    env,
                    observation,
                    config.reward,
                    seed=seed,
                    device=config.device,
                    mask=mask,
                )
                if current != (traffic, observation, mask):
                    # Drivers with the same observation and mask share an environment, so that it is
                    # compiled once.
                    current = (traffic, observation, mask)
                    batch = make(min(config.num_envs, episodes))
                report = None if quiet else _reporter(bar, f"{driver.name} on {traffic}")
                table = evaluation.run_episodes(
                    batch,
                    policy,
                    range(episodes),
                    seed,
                    report,
                    make,
                )
                table = table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic))
                # Episodes of one recorded scene are no independent observations.
                if isinstance(module, ReplayTraffic):
                    scenes = module.scenes_of_episodes(seed, table["episode"].to_list())
                    table = table.with_columns(pl.Series("scene", scenes, pl.String))
                tables.append(table)
    return pl.concat(tables, how="diagonal")


def _reporter(bar: tqdm, title: str) -> Callable[[int, int], None]:
    """Callback that shows the progress of one driver and traffic.

    On the bar, or as one line without a terminal.
    """
    bar.set_description(title)
    # The bar counts the episodes of all drivers, the callback those of one.
    before = bar.n

    def report(finished: int, wanted: int) -> None:
        bar.update(before + finished - bar.n)
        if bar.disable and finished == wanted:
            print(
                f"{title}: {wanted} episodes",
                file=sys.stderr,
                flush=True,
            )

    return report


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
        row = {
            "agent": agent,
            "traffic": traffic,
            **entries("per_km", per_km),
            "scenes": scenes,
        }
        rows.append(row)
    return rows


def publish(
    table: pl.DataFrame,
    folder: Path,
    config: Mapping[str, Any],
    seeds: Mapping[str, Any],
    numbers: Mapping[str, Any] | None = None,
) -> str:
    """Print the tables of what :func:`compare` gave, save its episodes and numbers.

    ``results.json`` holds ``rows``, ``paired`` (:func:`ganlane.evaluation.paired_rows`; a second
    table with two drivers or more), ``failures`` (:func:`ganlane.evaluation.failed_episodes`),
    ``crashes_by_scene`` where a traffic replays recorded scenes (:func:`recorded_crashes`), and
    further ``numbers``. Returns the line that names it.
    """
    # On the same episodes a difference shows long before two intervals part.
    rows = evaluation.evaluation_rows(table)
    paired = evaluation.paired_rows(table)
    tables = [evaluation.text_table(rows)]
    # A driver alone has nobody to be paired with.
    if paired:
        tables.append(evaluation.paired_table(paired))
    show(*tables, columns=config.get("columns", "all"))
    record: dict[str, Any] = {"rows": rows, "paired": paired}
    recorded = recorded_crashes(table)
    if recorded:
        record["crashes_by_scene"] = recorded
    record |= {"failures": evaluation.failed_episodes(table), **(numbers or {})}
    evaluation.write_episodes(folder, table)
    return f"results: {evaluation.write_results(folder, record, config, seeds)}"
