"""Drivers on the traffics of a suite, cell by cell: a file holds the episodes of each.

A cell that is there is not driven again, so a command that was stopped goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import polars as pl
from tqdm import tqdm

from ganlane.agents.drivers import Driver as RuleDriver
from ganlane.agents.drivers import GreedyPolicy
from ganlane.agents.stored_models import StoredModel
from ganlane.build import Driver, make_traffic
from ganlane.errors import UserError
from ganlane.evaluation import code_version
from ganlane.files import opened
from ganlane.settings.commands import EvaluateConfig
from ganlane.settings.record import plain
from ganlane.settings.suite import BenchmarkConfig
from ganlane.suite.driving import compare

#: Name in the metadata of a cell's file.
_ORIGIN = "ganlane"


@dataclass(frozen=True)
class Cell:
    """One driver on one traffic.

    Attributes:
        config: of the one traffic.
        path: of its file, named by everything that its episodes depend on but the code; None: the
            driver is a user's own code, whose episodes are not stored.
    """

    driver: Driver
    traffic: str
    config: EvaluateConfig
    path: Path | None


def available(config: BenchmarkConfig) -> tuple[list[str], dict[str, str]]:
    """The traffics that can be driven on here, and the others with the reason why not."""
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
    return [name for name in traffics if name not in missing], missing


def cells_of(
    drivers: Sequence[Driver], traffics: Sequence[str], config: BenchmarkConfig
) -> list[Cell]:
    """Every cell, traffic by traffic."""
    cells = []
    for traffic in traffics:
        alone = config.on(traffic)
        for driver in drivers:
            path = None
            # Of code of a user's own nobody knows when it changes.
            if isinstance(driver.policy, GreedyPolicy | RuleDriver | StoredModel):
                settings = json.dumps(_settings(driver, alone), sort_keys=True, default=str)
                digest = hashlib.sha256(settings.encode()).hexdigest()
                path = Path(config.cells) / f"{digest[:32]}.parquet"
            cells.append(Cell(driver, traffic, alone, path))
    return cells


def _settings(driver: Driver, config: EvaluateConfig) -> dict[str, Any]:
    """Everything that the episodes of a cell depend on, but the code."""
    # The weights themselves, not a file's name: a training under the same name is another driver.
    weights = hashlib.sha256()
    for name, value in driver.policy.state_dict().items():
        # Noise for exploring is drawn anew by every process.
        if not name.endswith("_epsilon"):
            weights.update(value.cpu().numpy().tobytes())
    driven, _ = driver.driving(config)
    settings = asdict(driven)
    # They change how fast the cell is driven, not what happens.
    for name in ("threads", "columns", "num_envs", "agents"):
        del settings[name]
    return {
        **settings,
        "driver": driver.name,
        "weights": weights.hexdigest(),
        "traffics": {name: plain(item) for name, item in config.traffics.items()},
    }


def drive(cells: Sequence[Cell]) -> tuple[pl.DataFrame, dict[str, float]]:
    """The episodes of all cells, one below the other, and seconds by driver.

    Cells that are stored are read, the others are driven.

    Raises:
        UserError: a stored file without the episodes of a cell; the message names it.
    """
    tables = []
    seconds: dict[str, float] = {}
    no_terminal = not sys.stderr.isatty()
    for cell in tqdm(cells, unit="cell", disable=no_terminal):
        name = cell.driver.name
        if cell.path is not None and cell.path.is_file():
            table, took_s = _read(cell.path)
        else:
            table, took_s = _drive(cell)
            if no_terminal:
                print(f"{name} on {cell.traffic}: {table.height} episodes", file=sys.stderr)
        tables.append(table)
        seconds[name] = seconds.get(name, 0.0) + took_s
    return pl.concat(tables, how="diagonal"), seconds


def _drive(cell: Cell) -> tuple[pl.DataFrame, float]:
    """Drive one cell and store it; its episodes, and the seconds that it took."""
    begun = time.monotonic()
    table = compare([cell.driver], cell.config, quiet=True, once=True)
    took_s = time.monotonic() - begun
    if cell.path is not None:
        # The file tells where it comes from, whoever finds it.
        origin = json.dumps({"code": code_version(), "seconds": took_s})
        with opened(cell.path) as file:
            table.write_parquet(file, metadata={_ORIGIN: origin})
    return table, took_s


def _read(path: Path) -> tuple[pl.DataFrame, float]:
    """A stored cell."""
    try:
        origin = json.loads(pl.read_parquet_metadata(path)[_ORIGIN])
        return pl.read_parquet(path), float(origin["seconds"])
    except (OSError, KeyError, ValueError, TypeError, pl.exceptions.PolarsError) as error:
        raise UserError(
            f"{path}: not the episodes of a cell ({error}); remove it and start again."
        ) from error
