"""Drivers on traffics, each on the same episodes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial

import polars as pl
from tqdm import tqdm

from ganlane import evaluation
from ganlane.build import Driver, make_env, make_traffic
from ganlane.settings.commands import EvaluateConfig
from ganlane.sim.random import Stream
from ganlane.traffic import ReplayTraffic


def compare(
    drivers: Sequence[Driver], config: EvaluateConfig, quiet: bool = False, once: bool = False
) -> pl.DataFrame:
    """Run the episodes of ``config`` with each driver on each of its traffics.

    Each of ``drivers`` (:func:`ganlane.build.make_driver`) drives with its own observation and
    mask, or with those of ``config`` if it names none; the sensors are those of ``config`` for all.
    ``quiet`` shows no progress. ``once``: where a traffic replays, no start of the recordings is
    driven twice (:meth:`ganlane.traffic.ReplayTraffic.episodes_once`), so that there may be fewer
    episodes.

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one
        below the other; and, where one of the traffics replays (null for the others), with
        ``scene``, the recorded scene of an episode, and ``car``, the recorded car that the ego
        replaces.
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
    with tqdm(total=total, unit="episode", file=sys.stderr, disable=disabled) as bar:
        for traffic, module in modules.items():
            numbers: Sequence[int] = range(episodes)
            if once and isinstance(module, ReplayTraffic):
                numbers = module.episodes_once(seed, env.idm)[:episodes]
            for driver in drivers:
                of_driver, policy = driver.driving(config)
                # All but the number of rows, which shrinks towards the end.
                make = partial(make_env, module, of_driver)
                parts = (traffic, of_driver.observation, of_driver.mask, of_driver.env.actions)
                if current != parts:
                    # Drivers with the same observation, mask and actions share an environment, so
                    # that it is compiled once.
                    current = parts
                    batch = make(min(config.num_envs, len(numbers)))
                report = None if quiet else _reporter(bar, f"{driver.name} on {traffic}")
                table = evaluation.run_episodes(batch, policy, numbers, seed, report, make)
                table = table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic))
                # Episodes of one recorded scene are no independent observations.
                if isinstance(module, ReplayTraffic):
                    driven = table["episode"].to_list()
                    table = table.with_columns(
                        pl.Series("scene", module.scenes_of_episodes(seed, driven), pl.String),
                        pl.Series("car", module.cars_of_episodes(seed, driven), pl.Int64),
                    )
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
            print(f"{title}: {wanted} episodes", file=sys.stderr, flush=True)

    return report
