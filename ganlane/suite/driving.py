"""Drivers on traffics, each on the same episodes.

For a suite every pair of driver and traffic is a cell, whose episodes are stored in a file. A cell
that is there is not driven again, so a command that was stopped goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import polars as pl
from tqdm import tqdm

from ganlane.agents.drivers import Driver as RuleDriver
from ganlane.agents.drivers import GreedyPolicy
from ganlane.agents.stored_models import StoredModel
from ganlane.build import Driver, make_env, make_traffic
from ganlane.errors import UserError
from ganlane.evaluation import code_version, run_episodes
from ganlane.files import opened
from ganlane.settings.commands import EvaluateConfig
from ganlane.settings.record import plain
from ganlane.settings.render import RenderConfig
from ganlane.settings.suite import BenchmarkConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.sim.random import Stream
from ganlane.traffic import ReplayTraffic
from ganlane.view.record import Trajectory, record_episode

#: Name in the metadata of a cell's file.
_ORIGIN = "ganlane"


def compare(
    drivers: Sequence[Driver],
    config: EvaluateConfig,
    quiet: bool = False,
) -> pl.DataFrame:
    """Run the episodes of ``config`` with each driver on each of its traffics.

    The progress is a bar, without a terminal a line per driver and traffic. Where a traffic
    replays, no start of the recordings is driven twice
    (:meth:`ganlane.traffic.ReplayTraffic.episodes_once`), so that there may be fewer episodes.

    Args:
        drivers: of :func:`ganlane.build.make_driver`. Each drives with its own observation and
            mask, or with those of ``config`` if it names none; the sensors are those of ``config``
            for all.
        config: traffics, episodes, seed and environment.
        quiet: no progress is shown.

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one
        below the other; and, where one of the traffics replays (null for the others), with
        ``scene``, the recorded scene of an episode, and ``car``, the recorded car that the ego
        replaces.

    Raises:
        UserError: a traffic cannot be made (:func:`ganlane.build.make_traffic`), its recordings
            have no start that can be driven, or a driver does not fit.
    """
    env = config.env
    seed = config.seed
    stream = Stream.named(config.stream)

    # All traffics are made first, so that one that cannot be made shows before any driving.
    modules = {}
    episodes: dict[str, Sequence[int]] = {}
    for name, option in config.traffics.items():
        module = make_traffic(option, env, stream)
        modules[name] = module
        episodes[name] = range(config.episodes)
        if isinstance(module, ReplayTraffic):
            episodes[name] = module.episodes_once(seed, env.idm)[: config.episodes]

    # One table per driver and traffic, concatenated at the end.
    tables = []
    total = len(drivers) * sum(map(len, episodes.values()))
    no_terminal = not sys.stderr.isatty()
    with tqdm(total=total, unit="episode", disable=quiet or no_terminal) as bar:
        for traffic, module in modules.items():
            numbers = episodes[traffic]
            for driver in drivers:
                title = f"{driver.name} on {traffic}"
                bar.set_description(title)

                # The settings with the driver's own observation and mask.
                of_driver, policy = driver.driving(config)
                # All but the number of rows, which shrinks towards the end.
                make = partial(make_env, module, of_driver)
                batch = make(min(config.num_envs, len(numbers)))
                report = partial(_advance, bar, bar.n)
                table = run_episodes(batch, policy, numbers, seed, report, make)
                if no_terminal and not quiet:
                    print(f"{title}: {table.height} episodes", file=sys.stderr)

                table = table.with_columns(
                    agent=pl.lit(driver.name),
                    traffic=pl.lit(traffic),
                )
                # Episodes of one recorded scene are no independent observations.
                if isinstance(module, ReplayTraffic):
                    driven = table["episode"].to_list()
                    table = table.with_columns(
                        pl.Series("scene", module.scenes_of_episodes(seed, driven), pl.String),
                        pl.Series("car", module.cars_of_episodes(seed, driven), pl.Int64),
                    )
                tables.append(table)

    # Only replayed episodes have a scene and a car, hence diagonal: the others get nulls.
    return pl.concat(tables, how="diagonal")


def _advance(bar: tqdm, before: int, finished: int, wanted: int) -> None:
    """Move the bar, which counts the episodes of all drivers: ``before`` were of others."""
    bar.update(before + finished - bar.n)


def drive_episode(
    driver: Driver,
    traffic: TrafficConfig,
    config: EvaluateConfig | RenderConfig,
    episode: int,
    end_s: float | None = None,
) -> Trajectory:
    """Record an episode of the seed and stream of ``config``, for a film or page.

    Args:
        driver: who drives.
        traffic: on what traffic; those of ``config`` do not count.
        config: seed, stream and environment.
        episode: its number.
        end_s: when the record ends, s from the start; None: with the episode.

    Raises:
        UserError: see :func:`ganlane.build.make_traffic`.
    """
    # A trained agent brings the mask and the observation that it was trained with.
    driven, policy = driver.driving(config)
    module = make_traffic(traffic, config.env, Stream.named(config.stream))
    env = make_env(module, driven)
    return record_episode(env, policy, config.seed, episode, driver.name, traffic.label(), end_s)


# --- the cells of a suite


def available(config: BenchmarkConfig) -> tuple[list[str], dict[str, str]]:
    """The traffics that can be driven on here, and the others with the reason why not.

    Raises:
        UserError: a traffic of the score cannot be made.
    """
    traffics = config.suite.traffics()
    missing = {}
    for name, option in traffics.items():
        try:
            # Made and thrown away: only now a missing package or recording shows.
            make_traffic(option, config.suite.env)
        except UserError as error:
            # The score needs all of its traffics.
            if name in config.suite.scored:
                raise
            missing[name] = str(error)

    can_be_driven = [name for name in traffics if name not in missing]
    return can_be_driven, missing


def drive_suite(
    drivers: Sequence[Driver],
    traffics: Sequence[str],
    config: BenchmarkConfig,
) -> tuple[pl.DataFrame, dict[str, float]]:
    """Drive every driver on every traffic of a suite, traffic by traffic.

    Cells that are stored are read, the others are driven and stored.

    Args:
        drivers: the suite's and the agents.
        traffics: names among those of the suite.
        config: the suite, and ``cells``, the folder of what was driven.

    Returns:
        The episodes of all cells, one below the other, with the columns of :func:`compare`; and by
        driver's name how long its cells took to drive, s, also where they were stored.

    Raises:
        UserError: a stored file without the episodes of a cell; the message names it.
    """
    # Every driver on a traffic before the next traffic.
    cells = [(driver, alone) for alone in map(config.on, traffics) for driver in drivers]

    tables = []
    seconds: dict[str, float] = {}
    for driver, alone in tqdm(cells, unit="cell", disable=not sys.stderr.isatty()):
        file = _file_of(driver, alone, Path(config.cells))
        # What was driven before is not driven again.
        if file is not None and file.is_file():
            table, took_s = _read(file)
        else:
            table, took_s = _drive(driver, alone, file)

        tables.append(table)
        seconds[driver.name] = seconds.get(driver.name, 0.0) + took_s

    # Cells of traffics that replay have columns more.
    return pl.concat(tables, how="diagonal"), seconds


def _file_of(driver: Driver, config: EvaluateConfig, folder: Path) -> Path | None:
    """The file of a cell, named by everything that its episodes depend on but the code.

    None for a user's own code, of which nobody knows when it changes: its episodes are not stored.
    """
    if not isinstance(driver.policy, GreedyPolicy | RuleDriver | StoredModel):
        return None

    # The weights themselves, not a file's name: a training under the same name is another driver.
    weights = hashlib.sha256()
    for name, value in driver.policy.state_dict().items():
        # Noise for exploring is drawn anew by every process.
        if not name.endswith("_epsilon"):
            weights.update(value.cpu().numpy().tobytes())

    # With the observation and the mask that the driver brings.
    driven, _ = driver.driving(config)
    settings = asdict(driven)
    # They change how fast the cell is driven, not what happens.
    for name in ("threads", "columns", "num_envs", "agents"):
        del settings[name]

    settings |= {
        "driver": driver.name,
        "weights": weights.hexdigest(),
        # By their keys alone: other fields are no settings.
        "traffics": {name: plain(item) for name, item in config.traffics.items()},
    }

    # Sorted, so that the same settings have the same name whatever their order.
    text = json.dumps(settings, sort_keys=True, default=str)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return folder / f"{digest[:32]}.parquet"


def _drive(driver: Driver, config: EvaluateConfig, file: Path | None) -> tuple[pl.DataFrame, float]:
    """Drive one cell and store it; its episodes, and the seconds that it took."""
    begun = time.monotonic()
    # On a terminal the bar of all cells tells how far it is, else a line for each of them.
    table = compare([driver], config, quiet=sys.stderr.isatty())
    took_s = time.monotonic() - begun

    if file is not None:
        # The file tells where it comes from, whoever finds it.
        origin = json.dumps({"code": code_version(), "seconds": took_s})
        with opened(file) as content:
            table.write_parquet(content, metadata={_ORIGIN: origin})
    return table, took_s


def _read(path: Path) -> tuple[pl.DataFrame, float]:
    """A stored cell: what :func:`_drive` returned; :class:`UserError` for another file."""
    try:
        # The metadata first: a table without them is no cell.
        origin = json.loads(pl.read_parquet_metadata(path)[_ORIGIN])
        return pl.read_parquet(path), float(origin["seconds"])
    except (OSError, KeyError, ValueError, TypeError, pl.exceptions.PolarsError) as error:
        raise UserError(
            f"{path}: not the episodes of a cell ({error}); remove it and start again."
        ) from error
