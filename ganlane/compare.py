"""Compare drivers: each one on each traffic, on the same episodes; the command ``ganlane evaluate``."""

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
from ganlane.config.commands import EvaluateConfig
from ganlane.evaluation.statistics import entries
from ganlane.evaluation.table import show
from ganlane.sim.random import Stream
from ganlane.torch_settings import set_threads
from ganlane.traffic import ReplayTraffic


def evaluate(config: EvaluateConfig, folder: Path) -> str:
    """``ganlane evaluate``: run the episodes, print and save the table; the line that names the results."""
    set_threads(config.threads)
    table = compare(make_drivers(config.agents, config.env, config.device), config)
    seeds = {"stream": config.stream, "seed": config.seed, "episodes": [0, config.episodes - 1]}
    return publish(table, folder, asdict(config), seeds)


def compare(drivers: Sequence[Driver], config: EvaluateConfig, quiet: bool = False) -> pl.DataFrame:
    """Run the episodes of ``config`` with each driver on each of its traffics.

    Args:
        drivers: see :func:`ganlane.build.make_driver`; each drives with its own observation and mask, or with those
            of ``config`` if it names none; the sensors are those of ``config`` for all.
        config: traffics, episodes and environment.
        quiet: show no progress.

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one below the other; and
        with ``scene``, the recorded scene of an episode, where one of the traffics replays (null for the others).
    """
    env, seed, episodes = config.env, config.seed, config.episodes
    stream = Stream.named(config.stream)
    modules = {name: make_traffic(traffic, env, stream) for name, traffic in config.chosen_traffics().items()}
    pairs = [(name, driver) for name in modules for driver in drivers]
    rows, tables = min(config.num_envs, episodes), []
    current = None
    disabled = quiet or not sys.stderr.isatty()
    with tqdm(total=len(pairs) * episodes, unit="episode", file=sys.stderr, disable=disabled) as bar:
        for number, (traffic, driver) in enumerate(pairs):
            observation = config.observation.read_by(driver.observation)
            mask, policy = driver.behind(config.mask)
            parts = (modules[traffic], env, observation, config.reward)
            make = partial(make_env, *parts, seed=seed, device=config.device, mask=mask)
            if current != (traffic, observation, mask):
                # Drivers with the same observation and mask share an environment, so that it is compiled once.
                current, batch = (traffic, observation, mask), make(rows)
            smaller = None if env.compile else make
            on_progress = None if quiet else _reporter(bar, f"{driver.name} on {traffic}", number * episodes)
            table = evaluation.run_episodes(batch, policy, range(episodes), seed, on_progress, smaller)
            table = table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic))
            if isinstance(module := modules[traffic], ReplayTraffic):
                scenes = module.scenes_of_episodes(seed, table["episode"].to_list())
                table = table.with_columns(pl.Series("scene", scenes, pl.String))
            tables.append(table)
    return pl.concat(tables, how="diagonal")


def _reporter(bar: tqdm, title: str, before: int) -> Callable[[int, int], None]:
    """Callback that shows the progress of one driver and traffic: on the bar, or as one line without a terminal."""
    bar.set_description(title)

    def report(finished: int, wanted: int) -> None:
        bar.update(before + finished - bar.n)
        if bar.disable and finished == wanted:
            print(f"{title}: {wanted} episodes", file=sys.stderr, flush=True)

    return report


def recorded_crashes(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Crashes per km of each agent on each traffic that replays recorded scenes; none for other traffics.

    Returns:
        Per pair ``agent, traffic, per_km, per_km_ci`` (bootstrap over whole scenes) and ``scenes``, see
        :func:`ganlane.evaluation.crashes_by_scene`.
    """
    if "scene" not in table.columns:
        return []
    rows = []
    recorded = table.filter(pl.col("scene").is_not_null())
    for (agent, traffic), episodes in recorded.group_by("agent", "traffic", maintain_order=True):
        crashes = evaluation.crashes_by_scene(episodes, episodes["scene"].to_list())
        per_km = entries("per_km", crashes.per_km)
        rows.append({"agent": agent, "traffic": traffic, **per_km, "scenes": crashes.rows})
    return rows


def publish(
    table: pl.DataFrame,
    folder: Path,
    config: Mapping[str, Any],
    seeds: Mapping[str, Any],
    numbers: Mapping[str, Any] | None = None,
) -> str:
    """Print the tables of a comparison, write its episodes and ``results.json``; return the line that names it.

    The record also holds ``paired`` (:func:`ganlane.evaluation.paired_rows`; a second table with two drivers or
    more), ``failures`` (:func:`ganlane.evaluation.failed_episodes`) and, where a traffic replays recorded scenes,
    ``crashes_by_scene`` (:func:`recorded_crashes`).

    Args:
        table: what :func:`compare` returned.
        folder: of the run.
        config, seeds: of the run, for the record.
        numbers: further entries of the record.
    """
    rows, paired, recorded = evaluation.evaluation_rows(table), evaluation.paired_rows(table), recorded_crashes(table)
    tables = [evaluation.text_table(rows), *([evaluation.paired_table(paired)] if paired else [])]
    show(*tables, columns=config.get("columns", "all"))
    evaluation.write_episodes(folder, table)
    scenes = {"crashes_by_scene": recorded} if recorded else {}
    failures = evaluation.failed_episodes(table)
    record = {"rows": rows, "paired": paired, **scenes, "failures": failures, **(numbers or {})}
    return f"results: {evaluation.write_results(folder, record, config, seeds)}"
