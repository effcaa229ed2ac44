"""Drivers beside each other: every one on every traffic, on the same episodes."""

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

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one below the other; and
        with ``scene``, the recorded scene of an episode, where one of the traffics replays (null for the others).
    """
    modules = {name: make_traffic(config, env, stream) for name, config in traffics.items()}
    pairs = [(name, driver) for name in modules for driver in drivers]
    rows, tables = min(num_envs, episodes), []
    made: tuple[tuple[str, ObservationConfig, MaskParameters], EnvBase] | None = None
    with _Progress(len(pairs) * episodes) as progress:
        for traffic, driver in pairs:
            seen = (observation or ObservationConfig()).read_by(driver.observation)
            shield, policy = driver.behind(mask)
            make = partial(make_env, modules[traffic], env, seen, reward, seed=seed, device=device, mask=shield)
            if made is None or made[0] != (traffic, seen, shield):
                # Drivers that see the same share an environment, which is compiled once then.
                made = (traffic, seen, shield), make(rows)
            smaller = None if env.compile else make
            report = progress.start(f"{driver.name} on {traffic}")
            table = run_episodes(made[1], policy, range(episodes), seed, report, smaller)
            named = table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic))
            tables.append(_with_scenes(named, modules[traffic], seed))
    return pl.concat(tables, how="diagonal")


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
        per_km = {"per_km": crashes.per_km.value, "per_km_ci": crashes.per_km.interval}
        found.append({"agent": agent, "traffic": traffic, **per_km, "scenes": crashes.rows})
    return found


def compare_as_told(drivers: Sequence[Driver], config: EvaluateConfig) -> pl.DataFrame:
    """:func:`compare` with everything else as ``config`` says."""
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
    )


def publish(
    table: pl.DataFrame,
    folder: Path,
    config: Mapping[str, Any],
    seeds: Mapping[str, Any],
    numbers: Mapping[str, Any] | None = None,
) -> str:
    """Print the table of a comparison, write its episodes and ``results.json``; the line that names the latter.

    With two drivers or more a second table, and ``paired`` in the record, say by how much the first one is ahead of
    each of the others on the same episodes (:func:`ganlane.evaluation.paired_rows`). Where a traffic replays recorded
    scenes, the record holds ``crashes_by_scene`` (:func:`recorded_crashes`).

    Args:
        table: what :func:`compare` returned.
        folder: of the run.
        config, seeds: of the run, for the record.
        numbers: what the record holds beside ``rows``.
    """
    rows, paired = evaluation_rows(table), paired_rows(table)
    print(text_table(rows))
    if paired:
        print(f"\n{paired_table(paired)}")
    write_episodes(folder, table)
    recorded = recorded_crashes(table)
    scenes = {"crashes_by_scene": recorded} if recorded else {}
    known = {"rows": rows, "paired": paired, **scenes, **(numbers or {})}
    return f"results: {write_results(folder, known, config, seeds)}"


class _Progress:
    """A bar on a terminal, elsewhere a line for every driver and traffic."""

    def __init__(self, total: int) -> None:
        self._bar = tqdm(total=total, unit="episode", file=sys.stderr, disable=not sys.stderr.isatty())
        self._finished = 0

    def start(self, title: str) -> Callable[[int, int], None]:
        """Begin with the next driver and traffic; the function to call as its episodes finish."""
        before = self._finished
        self._bar.set_description(title)

        def report(finished: int, wanted: int) -> None:
            self._finished = before + finished
            self._bar.update(self._finished - self._bar.n)
            if self._bar.disable and finished == wanted:
                print(f"{title}: {wanted} episodes", file=sys.stderr, flush=True)

        return report

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
