"""The matrix of drivers and traffics, cell by cell: a file holds the episodes of each.

A cell that is there is not driven again, so a command that was stopped goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import polars as pl
from tqdm import tqdm

from ganlane.build import Driver, make_driver, make_drivers, make_traffic
from ganlane.compare import compare
from ganlane.errors import UserError
from ganlane.evaluation import code_version
from ganlane.files import opened
from ganlane.settings.commands import ReproduceConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.torch_settings import set_threads

#: Name in the metadata of a cell's file.
_ORIGIN = "ganlane"


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
    at_hand: dict[str, TrafficConfig] = {}
    missing: dict[str, str] = {}
    for name, option in config.traffics.items():
        try:
            # Made and thrown away: only now a missing package or recording shows.
            make_traffic(option, config.env)
            at_hand[name] = option
        except UserError as error:
            missing[name] = str(error)
    if not at_hand:
        reason = next(iter(missing.values()))
        raise UserError(f"traffics: none of them can be driven on here ({reason})")
    return at_hand, missing


def cells_of(config: ReproduceConfig, traffics: dict[str, TrafficConfig]) -> list[Cell]:
    """Every cell, traffic by traffic.

    :class:`UserError` for a driver that is not known or does not fit.
    """
    drivers = make_drivers(config.agents, config.env, config.device)
    cells = []
    for traffic, option in traffics.items():
        # A changed setting gives another file name, so that old episodes are never taken for new
        # ones.
        for driver in drivers:
            settings = _settings(driver, option, config, config.episodes_on(traffic))
            digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
            path = Path(config.cells) / f"{digest[:32]}.parquet"
            cells.append(Cell(driver.name, traffic, settings, path))
    return cells


def _settings(
    driver: Driver,
    traffic: TrafficConfig,
    config: ReproduceConfig,
    episodes: int,
) -> dict[str, Any]:
    """See :class:`Cell`."""
    # The weights themselves, not a file's name: a training under the same name is another driver.
    weights = hashlib.sha256()
    for name, value in driver.policy.state_dict().items():
        # Noise for exploring is drawn anew by every process.
        if not name.endswith("_epsilon"):
            weights.update(value.cpu().numpy().tobytes())
    mask, _ = driver.behind(config.mask)
    env = asdict(config.env)
    # It changes how fast the cell is driven, not what happens.
    del env["compile"]
    settings = {
        "driver": driver.name,
        "weights": weights.hexdigest(),
        "mask": asdict(mask),
        "observation": asdict(config.observation.read_by(driver.observation)),
        "traffic": traffic.description(),
        "env": env,
        "reward": asdict(config.reward),
        "episodes": episodes,
        "stream": config.stream,
        "seed": config.seed,
        "num_envs": min(config.num_envs, episodes),
        "device": config.device,
    }
    # As it will be read from the file again, so that two such records can be compared.
    return json.loads(json.dumps(settings, default=str))


def drive(cells: Sequence[Cell], config: ReproduceConfig) -> None:
    """Drive the cells that are not there yet, each into its file."""
    # What an earlier command drove is taken as it is.
    missing = [cell for cell in cells if not cell.path.is_file()]
    no_terminal = not sys.stderr.isatty()
    driven = _driven(missing, config)
    for cell in tqdm(driven, total=len(missing), unit="cell", disable=no_terminal):
        if no_terminal:
            episodes = cell.settings["episodes"]
            print(f"{cell.driver} on {cell.traffic}: {episodes} episodes", file=sys.stderr)


def _driven(cells: Sequence[Cell], config: ReproduceConfig) -> Iterator[Cell]:
    """Drive the cells; yield each when it is finished."""
    if min(config.workers, len(cells)) <= 1:
        for cell in cells:
            drive_cell(cell, config)
            yield cell
        return
    # Fresh processes: torch does not survive a fork once it has computed something.
    # Ctrl-C reaches them too: they finish their cell.
    quiet = (signal.SIGINT, signal.SIG_IGN)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(config.workers, context, signal.signal, quiet) as pool:
        # Traffic by traffic, as in the list; slow ones may end later.
        jobs = {pool.submit(drive_cell, cell, config): cell for cell in cells}
        try:
            for job in as_completed(jobs):
                job.result()
                yield jobs[job]
        # Ctrl-C as well: what is running ends, what waits is dropped.
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def drive_cell(cell: Cell, config: ReproduceConfig) -> None:
    """Drive one cell and write its file."""
    set_threads(config.threads)
    begun = time.monotonic()
    # The same call as in ganlane evaluate, with one driver on one traffic.
    traffics = {cell.traffic: config.traffics[cell.traffic]}
    alone = replace(config, traffics=traffics, episodes=cell.settings["episodes"])
    driver = make_driver(cell.driver, config.env, device=config.device)
    table = compare([driver], alone, quiet=True)
    # The file tells what it holds, whoever finds it.
    origin = {
        "settings": cell.settings,
        "code": code_version(),
        "seconds": round(time.monotonic() - begun, 3),
    }
    with opened(cell.path) as file:
        table.write_parquet(file, metadata={_ORIGIN: json.dumps(origin)})


def read_cells(cells: Sequence[Cell]) -> tuple[pl.DataFrame, list[str], dict[str, float]]:
    """All episodes, one below the other, the revisions that drove them, seconds by traffic.

    Raises:
        UserError: a file without the episodes of a cell; the message names it.
    """
    tables = []
    revisions = set()
    seconds = dict.fromkeys((cell.traffic for cell in cells), 0.0)
    for cell in cells:
        try:
            origin = json.loads(pl.read_parquet_metadata(cell.path)[_ORIGIN])
            tables.append(pl.read_parquet(cell.path))
            # An installed package has a version, but no revision.
            revisions.add(str(origin["code"]["revision"] or origin["code"]["version"]))
            seconds[cell.traffic] += float(origin["seconds"])
        except (OSError, KeyError, ValueError, TypeError, pl.exceptions.PolarsError) as error:
            raise UserError(
                f"{cell.path}: not the episodes of a cell ({error}); remove it and start again."
            ) from error
    return pl.concat(tables, how="diagonal"), sorted(revisions), seconds
