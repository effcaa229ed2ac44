"""Drivers beside each other: every one on every traffic, on the same episodes."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

import polars as pl
from tqdm import tqdm

from ganlane.build import Driver, make_env, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.observation import ObservationConfig
from ganlane.config.reward import RewardConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.evaluation import run_episodes
from ganlane.sim.random import Stream


def compare(
    drivers: Sequence[Driver],
    traffics: Mapping[str, TrafficConfig],
    env: EnvConfig,
    reward: RewardConfig | None = None,
    observation: ObservationConfig | None = None,
    episodes: int = 100,
    seed: int = 0,
    num_envs: int = 128,
    device: str = "cpu",
    stream: int = Stream.REPORT,
) -> pl.DataFrame:
    """Run the episodes 0 to ``episodes - 1`` with each driver on each traffic.

    Args:
        drivers: see :func:`ganlane.build.make_driver`; each gets an environment with its own observation.
        traffics: name to config.
        env, reward: the same for all.
        observation: for drivers that name none.
        episodes, seed, stream: which episodes.
        num_envs: episodes side by side, at most.

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one below the other.
    """
    modules = {name: make_traffic(config, env, stream) for name, config in traffics.items()}
    rows, parts = min(num_envs, episodes), []
    with tqdm(total=len(modules) * len(drivers) * episodes, unit="episode", file=sys.stderr, leave=False) as bar:
        for traffic, module in modules.items():
            for driver in drivers:
                bar.set_description(f"{driver.name} on {traffic}")
                before = bar.n
                made = make_env(module, env, driver.observation or observation, reward, rows, seed, device)
                table = run_episodes(
                    made,
                    driver.policy,
                    range(episodes),
                    seed,
                    lambda done, _, start=before: bar.update(start + done - bar.n),
                )
                parts.append(table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic)))
    return pl.concat(parts)
