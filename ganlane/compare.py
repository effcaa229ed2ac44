"""Drivers beside each other: every one on every traffic, on the same episodes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence

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
    pairs = [(name, driver) for name in modules for driver in drivers]
    rows, tables = min(num_envs, episodes), []
    with _Progress(len(pairs) * episodes) as progress:
        for traffic, driver in pairs:
            seen = driver.observation or observation
            made = make_env(modules[traffic], env, seen, reward, rows, seed, device)
            report = progress.start(f"{driver.name} on {traffic}")
            table = run_episodes(made, driver.policy, range(episodes), seed, report)
            tables.append(table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic)))
    return pl.concat(tables)


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
