"""Compare drivers: each one on each traffic, on the same episodes.

A matrix of them cell by cell, a file for each.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
from tqdm import tqdm

from ganlane import evaluation
from ganlane.build import Driver, make_driver, make_drivers, make_env, make_traffic
from ganlane.settings.commands import EvaluateConfig, ReproduceConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.evaluation.statistics import entries
from ganlane.evaluation.table import show
from ganlane.files import atomic_path
from ganlane.sim.random import Stream
from ganlane.torch_settings import set_threads
from ganlane.traffic import ReplayTraffic

#: Name in the metadata of a cell's file.
_ORIGIN = "ganlane"


def evaluate(config: EvaluateConfig, folder: Path) -> str:
    """``ganlane evaluate``: run the episodes, print and save the table.

    The line that names the results.
    """
    set_threads(config.threads)
    table = compare(make_drivers(config.agents, config.env, config.device), config)
    seeds = {"stream": config.stream, "seed": config.seed, "episodes": [0, config.episodes - 1]}
    return publish(table, folder, asdict(config), seeds)


def compare(drivers: Sequence[Driver], config: EvaluateConfig, quiet: bool = False) -> pl.DataFrame:
    """Run the episodes of ``config`` with each driver on each of its traffics.

    Each of ``drivers`` (:func:`ganlane.build.make_driver`) drives with its own observation and
    mask, or with those of ``config`` if it names none; the sensors are those of ``config`` for all.
    ``quiet`` shows no progress.

    Returns:
        What :func:`ganlane.evaluation.run_episodes` gives, with ``agent`` and ``traffic``, one
        below the other; and with ``scene``, the recorded scene of an episode, where one of the
        traffics replays (null for the others).
    """
    env, seed, episodes = config.env, config.seed, config.episodes
    stream = Stream.named(config.stream)
    modules = {
        name: make_traffic(traffic, env, stream) for name, traffic in config.traffics.items()
    }
    pairs = [(name, driver) for name in modules for driver in drivers]
    rows, tables = min(config.num_envs, episodes), []
    current = None
    disabled = quiet or not sys.stderr.isatty()
    with tqdm(
        total=len(pairs) * episodes, unit="episode", file=sys.stderr, disable=disabled
    ) as bar:
        for number, (traffic, driver) in enumerate(pairs):
            observation = config.observation.read_by(driver.observation)
            mask, policy = driver.behind(config.mask)
            parts = (modules[traffic], env, observation, config.reward)
            make = partial(make_env, *parts, seed=seed, device=config.device, mask=mask)
            if current != (traffic, observation, mask):
                # Drivers with the same observation and mask share an environment, so that it is
                # compiled once.
                current, batch = (traffic, observation, mask), make(rows)
            smaller = None if env.compile else make
            on_progress = (
                None if quiet else _reporter(bar, f"{driver.name} on {traffic}", number * episodes)
            )
            table = evaluation.run_episodes(
                batch, policy, range(episodes), seed, on_progress, smaller
            )
            table = table.with_columns(agent=pl.lit(driver.name), traffic=pl.lit(traffic))
            if isinstance(module := modules[traffic], ReplayTraffic):
                scenes = module.scenes_of_episodes(seed, table["episode"].to_list())
                table = table.with_columns(pl.Series("scene", scenes, pl.String))
            tables.append(table)
    return pl.concat(tables, how="diagonal")


def _reporter(bar: tqdm, title: str, before: int) -> Callable[[int, int], None]:
    """Callback that shows the progress of one driver and traffic.

    On the bar, or as one line without a terminal.
    """
    bar.set_description(title)

    def report(finished: int, wanted: int) -> None:
        bar.update(before + finished - bar.n)
        if bar.disable and finished == wanted:
            print(f"{title}: {wanted} episodes", file=sys.stderr, flush=True)

    return report


def recorded_crashes(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Crashes per km of each agent on each traffic that replays recorded scenes; none for other
    traffics.

    Returns:
        Per pair ``agent, traffic, per_km, per_km_ci`` (bootstrap over whole scenes) and ``scenes``,
        see :func:`ganlane.evaluation.crashes_by_scene`.
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
    """Print the tables of what :func:`compare` gave, write its episodes and ``results.json``; the
    line that names it.

    The record holds ``rows``, ``paired`` (:func:`ganlane.evaluation.paired_rows`; a second table
    with two drivers or more), ``failures`` (:func:`ganlane.evaluation.failed_episodes`),
    ``crashes_by_scene`` where a traffic replays recorded scenes (:func:`recorded_crashes`), and
    further ``numbers``.
    """
    rows, paired, recorded = (
        evaluation.evaluation_rows(table),
        evaluation.paired_rows(table),
        recorded_crashes(table),
    )
    tables = [evaluation.text_table(rows), *([evaluation.paired_table(paired)] if paired else [])]
    show(*tables, columns=config.get("columns", "all"))
    evaluation.write_episodes(folder, table)
    scenes = {"crashes_by_scene": recorded} if recorded else {}
    failures = evaluation.failed_episodes(table)
    record = {"rows": rows, "paired": paired, **scenes, "failures": failures, **(numbers or {})}
    return f"results: {evaluation.write_results(folder, record, config, seeds)}"


@dataclass(frozen=True)
class Cell:
    """One driver on one traffic.

    Attributes:
        settings: everything that its episodes depend on, but the code; plain data.
        path: of its file; the name is made from the settings.
    """

    driver: str
    traffic: str
    settings: dict[str, Any]
    path: Path


def available(config: ReproduceConfig) -> tuple[dict[str, TrafficConfig], dict[str, str]]:
    """The traffics that can be driven on here, and the others with the reason why not.

    Raises:
        UserError: none of them can.
    """
    there: dict[str, TrafficConfig] = {}
    missing: dict[str, str] = {}
    for name, option in config.traffics.items():
        try:
            make_traffic(option, config.env)
            there[name] = option
        except UserError as error:
            missing[name] = str(error)
    if not there:
        raise UserError(
            f"traffics: none of them can be driven on here ({next(iter(missing.values()))})"
        )
    return there, missing


def cells_of(config: ReproduceConfig, traffics: dict[str, TrafficConfig]) -> list[Cell]:
    """Every cell, traffic by traffic.

    :class:`UserError` for a driver that is not known or does not fit.
    """
    drivers = make_drivers(config.agents, config.env, config.device)
    cells = []
    for traffic, option in traffics.items():
        for driver in drivers:
            settings = _settings(driver, option, config, config.episodes_on(traffic))
            digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
            cells.append(
                Cell(driver.name, traffic, settings, Path(config.cells) / f"{digest[:32]}.parquet")
            )
    return cells


def _settings(
    driver: Driver, traffic: TrafficConfig, config: ReproduceConfig, episodes: int
) -> dict[str, Any]:
    weights = hashlib.sha256()
    for name, value in driver.policy.state_dict().items():
        if not name.endswith("_epsilon"):  # noise for exploring, drawn anew by every process
            weights.update(value.cpu().numpy().tobytes())
    mask, _ = driver.behind(config.mask)
    settings = {
        "driver": driver.name,
        "weights": weights.hexdigest(),
        "mask": asdict(mask),
        "observation": asdict(config.observation.read_by(driver.observation)),
        "traffic": traffic.description(),
        "env": {key: value for key, value in asdict(config.env).items() if key != "compile"},
        "reward": asdict(config.reward),
        "episodes": episodes,
        "stream": config.stream,
        "seed": config.seed,
        "num_envs": min(config.num_envs, episodes),
        "device": config.device,
    }
    return json.loads(json.dumps(settings, default=str))


def drive(cells: Sequence[Cell], config: ReproduceConfig) -> int:
    """Drive the cells that are not there yet, each into its file; how many there were."""
    missing = [cell for cell in cells if not cell.path.is_file()]
    bar = tqdm(total=len(missing), unit="cell", file=sys.stderr, disable=not sys.stderr.isatty())
    with bar:
        for cell in _driven(missing, config):
            bar.update()
            if bar.disable:
                print(
                    f"{cell.driver} on {cell.traffic}: {cell.settings['episodes']} episodes",
                    file=sys.stderr,
                )
    return len(missing)


def _driven(cells: Sequence[Cell], config: ReproduceConfig) -> Iterator[Cell]:
    """Drive the cells; yield each when it is finished."""
    if min(config.workers, len(cells)) <= 1:
        for cell in cells:
            drive_cell(cell, config)
            yield cell
        return
    # Fresh processes: torch does not survive a fork once it has computed something.
    # Ctrl-C reaches them too: they finish their cell.
    quiet: Any = {"initializer": signal.signal, "initargs": (signal.SIGINT, signal.SIG_IGN)}
    with ProcessPoolExecutor(config.workers, multiprocessing.get_context("spawn"), **quiet) as pool:
        jobs = {pool.submit(drive_cell, cell, config): cell for cell in cells}
        try:
            for job in as_completed(jobs):
                job.result()
                yield jobs[job]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def drive_cell(cell: Cell, config: ReproduceConfig) -> None:
    """Drive one cell and write its file."""
    set_threads(config.threads)
    begun = time.monotonic()
    alone = replace(config, traffics=[cell.traffic], episodes=cell.settings["episodes"])
    table = compare([make_driver(cell.driver, config.env, device=config.device)], alone, quiet=True)
    seconds = round(time.monotonic() - begun, 3)
    origin = json.dumps(
        {"settings": cell.settings, "code": evaluation.code_version(), "seconds": seconds}
    )
    with atomic_path(cell.path) as part:
        table.write_parquet(part, metadata={_ORIGIN: origin})


def read_cells(cells: Sequence[Cell]) -> tuple[pl.DataFrame, list[str], dict[str, float]]:
    """All episodes, one below the other, the revisions that drove them, and how long each traffic
    took, s.

    A file that does not say how long it took counts as 0.

    Raises:
        UserError: a file without the episodes of a cell; the message names it.
    """
    tables, revisions, seconds = [], set(), dict.fromkeys((cell.traffic for cell in cells), 0.0)
    for cell in cells:
        try:
            origin = json.loads(pl.read_parquet_metadata(cell.path)[_ORIGIN])
            tables.append(pl.read_parquet(cell.path))
            revisions.add(str(origin["code"]["revision"] or origin["code"]["version"]))
            seconds[cell.traffic] += float(origin.get("seconds", 0.0))
        except (OSError, KeyError, ValueError, pl.exceptions.PolarsError) as error:
            raise UserError(
                f"{cell.path}: not the episodes of a cell ({error}); remove it and start again."
            ) from error
    return pl.concat(tables, how="diagonal"), sorted(revisions), seconds
