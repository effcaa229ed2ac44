"""The drivers of the matrix on other roads: fewer and more vehicles, fewer and more lanes than in
their training.

    python -m benchmarks.roads                                  # ten minutes on one core
    python -m benchmarks.roads 'traffics=[idm_mobil,gan]' 'fewer={gan:300}' env.compile=true
    # 100 minutes

What is given besides ``--out`` are options of ``ganlane reproduce``. Vehicles stand at Table II's
density, so that more of them fill a longer road (``env=dense``); with other lanes there are nine of
them on 200 m, as in the paper. Cells that were driven are not driven again.
``python -m benchmarks.printed --write`` makes the table of the document.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.script import make_parser, run_script
from ganlane.compare import available, cells_of, drive, read_cells
from ganlane.config.command_line import check
from ganlane.settings.commands import ReproduceConfig
from ganlane.evaluation import write_results
from ganlane.reproduce import report

OUT = Path("docs/reproduce/roads")
#: Vehicles, the ego included, and lanes. The first is the paper's, on which all agents were
#: trained.
ROADS = ((9, 3), (6, 3), (15, 3), (30, 3), (9, 2), (9, 4), (9, 5))
BEHIND = ("agent_idm@all+safe", "agent_gan@all+safe", "agent_general@all+safe")
OPTIONS = (
    f"agents=[mobil,mobil_egoistic,{','.join(BEHIND)}]",
    *("traffics=[idm_mobil]", "episodes=300", "workers=1"),
)
#: What is kept of a row, with the intervals.
KEPT = (
    "driver",
    "traffic",
    "trainings",
    "episodes",
    "mean_reward",
    "minus_mobil",
    "hard_crash",
    "out_of_road",
)


def config_of(vehicles: int, lanes: int, options: Sequence[str]) -> ReproduceConfig:
    """The matrix on one road."""
    dense = [] if vehicles == ROADS[0][0] else ["env=dense", f"env.vehicles={vehicles}"]
    road = [*dense, f"env.lanes={lanes}"]
    config = check("reproduce", [*road, *OPTIONS, *options]).config
    assert isinstance(config, ReproduceConfig)
    return config


def rows_on(
    vehicles: int, lanes: int, config: ReproduceConfig
) -> tuple[list[dict[str, Any]], list[str]]:
    """The rows of a road, driven where they are missing, and the revisions that drove them."""
    traffics, _ = available(config)
    cells = cells_of(config, traffics)
    drive(cells, config)
    episodes, revisions, _ = read_cells(cells)
    kept = {*KEPT, *(f"{name}_ci" for name in KEPT)}
    rows = report.rows(report.by_recipe(episodes))
    place = {"vehicles": vehicles, "lanes": lanes}
    return [
        place | {name: value for name, value in row.items() if name in kept} for row in rows
    ], revisions


def measure(options: argparse.Namespace) -> str:
    """Drive on every road; the path of the results."""
    configs = {road: config_of(*road, options.options) for road in ROADS}
    rows, revisions = [], set()
    for road, config in configs.items():
        found, by = rows_on(*road, config)
        rows += found
        revisions |= set(by)
    record = {
        "command": shlex.join(["python", "-m", "benchmarks.roads", *options.options]),
        "rows": rows,
        "revisions": sorted(revisions),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    config = configs[ROADS[0]]
    seeds = {
        "stream": config.stream,
        "seed": config.seed,
        "episodes": {name: config.episodes_on(name) for name in config.chosen_traffics()},
    }
    return f"results: {write_results(options.out, record, asdict(config), seeds)}"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "options", nargs="*", metavar="KEY=VALUE", help="options of ganlane reproduce"
    )
    parser.add_argument("--out", type=Path, default=OUT, help=f"folder of results.json ({OUT})")
    return parser.parse_intermixed_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive; the exit status."""
    return run_script(measure, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
