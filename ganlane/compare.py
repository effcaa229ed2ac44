"""Drivers compared: every one on every traffic, on the same episodes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
from torchrl.envs import EnvBase
from tqdm import tqdm

from ganlane.build import Driver, make_env, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.evaluate import EvaluateConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.evaluation import (
    crashes_by_scene,
    evaluation_rows,
    paired_rows,
    paired_table,
    run_episodes,
    text_table,
    write_episodes,
    write_results,
)
from ganlane.evaluation.statistics import entries
from ganlane.evaluation.table import show
from ganlane.parameters.observation import MaskParameters, ObservationConfig
from ganlane.parameters.reward import RewardParameters
from ganlane.sim.random import Stream
from ganlane.traffic import ReplayTraffic, TrafficModule


def compare(
    drivers: Sequence[Driver],
    traffics: Mapping[str, TrafficConfig],
    env: EnvConfig,
    reward: RewardParameters | None = None,
    observation: ObservationConfig | None = None,
    episodes: int = 100,
    seed: int = 0,
    num_envs: int = 512,
    device: str = "cpu",
    stream: int = Stream.REPORT,
    mask: MaskParameters | None = None,
    quiet: bool = False,
) -> pl.DataFrame:
    """Run the episodes 0 to ``episodes - 1`` with each driver on each traffic.

    Args:
        drivers: see :func:`ganlane.build.make_driver`; each drives with its own observation.
        traffics: name to config.
        env, reward: the same for all.
        observation: for drivers that name none; its sensors for all.
        episodes, seed, stream: which episodes.
        num_envs: episodes side by side, at most.
        mask: for drivers that name none.
        quiet: without signs of progress.

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one below the other; and
        with ``scene``, the recorded scene of an episode, where one of the traffics replays (null for the others).
    """
    modules = {name: make_traffic(config, env, stream) for name, config in traffics.items()}
    pairs = [(name, driver) for name in modules for driver in drivers]
    rows, tables = min(num_envs, episodes), []
    made: tuple[tuple[str, ObservationConfig, MaskParameters], EnvBase] | None = None
    disabled = quiet or not sys.stderr.isatty()
    bar = tqdm(total=len(pairs) * episodes, unit="episode", file=sys.stderr, disable=disabled)
    with bar:
        for number, (traffic, driver) in enumerate(pairs):
            own_observation = (observation or ObservationConfig()).read_by(driver.observation)
            own_mask, policy = driver.behind(mask)
            make = partial(
                make_env, modules[traffic], env, own_observation, reward, seed=seed, device=device, mask=own_mask
            )
            if made is None or made[0] != (traffic, own_observation, own_mask):
                # Drivers with the same observation and mask share an environment, so that it is compiled once.
                made = (traffic, own_observation, own_mask), make(rows)
            smaller = None if env.compile else make
            title, before = f"{driver.name} on {traffic}", number * episodes
            on_progress = None if quiet else _reporter(bar, title, before)
            table = run_episodes(made[1], policy, range(episodes), seed, on_progress, smaller)
            named = table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic))
            tables.append(_with_scenes(named, modules[traffic], seed))
    return pl.concat(tables, how="diagonal")


def compare_configured(drivers: Sequence[Driver], config: EvaluateConfig, quiet: bool = False) -> pl.DataFrame:
    """:func:`compare` with the traffics, episodes and environment of ``config``."""
    return compare(
        drivers,
        config.chosen_traffics(),
        config.env,
        config.reward,
        config.observation,
        config.episodes,
        config.seed,
        config.num_envs,
        config.device,
        Stream[config.stream.upper()],
        config.mask,
        quiet,
    )


def _reporter(bar: tqdm, title: str, before: int) -> Callable[[int, int], None]:
    """Shows the progress of one driver and traffic: on the bar, or as one line where there is no terminal."""
    bar.set_description(title)

    def report(finished: int, wanted: int) -> None:
        bar.update(before + finished - bar.n)
        if bar.disable and finished == wanted:
            print(f"{title}: {wanted} episodes", file=sys.stderr, flush=True)

    return report


def _with_scenes(table: pl.DataFrame, traffic: TrafficModule, seed: int) -> pl.DataFrame:
    """The episodes with the name of the recorded ``scene`` of each, if there is one."""
    if not isinstance(traffic, ReplayTraffic):
        return table
    scenes = traffic.scenes_of_episodes(seed, table["episode"].to_list())
    return table.with_columns(pl.Series("scene", scenes, pl.String))


def recorded_crashes(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Crashes per km of each agent on each traffic that replays recorded scenes; none for other traffics.

    Returns:
        Per pair ``agent, traffic, per_km, per_km_ci`` (bootstrap over whole scenes) and ``scenes``, see
        :func:`ganlane.evaluation.crashes_by_scene`.
    """
    if "scene" not in table.columns:
        return []
    found = []
    recorded = table.filter(pl.col("scene").is_not_null())
    for (agent, traffic), episodes in recorded.group_by("agent", "traffic", maintain_order=True):
        crashes = crashes_by_scene(episodes, episodes["scene"].to_list())
        found.append(
            {"agent": agent, "traffic": traffic, **entries("per_km", crashes.per_km), "scenes": crashes.rows}
        )
    return found


def publish(
    table: pl.DataFrame,
    folder: Path,
    config: Mapping[str, Any],
    seeds: Mapping[str, Any],
    numbers: Mapping[str, Any] | None = None,
) -> str:
    """Print the tables of a comparison, write its episodes and ``results.json``; the line that names the latter.

    The record also holds ``paired`` (:func:`ganlane.evaluation.paired_rows`; a second table with two drivers or more)
    and, where a traffic replays recorded scenes, ``crashes_by_scene`` (:func:`recorded_crashes`).

    Args:
        table: what :func:`compare` returned.
        folder: of the run.
        config, seeds: of the run, for the record.
        numbers: further entries of the record.
    """
    rows, paired, recorded = evaluation_rows(table), paired_rows(table), recorded_crashes(table)
    show(text_table(rows), *([paired_table(paired)] if paired else []), columns=config.get("columns", "all"))
    write_episodes(folder, table)
    scenes = {"crashes_by_scene": recorded} if recorded else {}
    record = {"rows": rows, "paired": paired, **scenes, **(numbers or {})}
    return f"results: {write_results(folder, record, config, seeds)}"
