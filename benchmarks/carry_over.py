"""Tables of drivers on traffics from the folders of several ``ganlane evaluate`` runs, as Markdown.

    python -m benchmarks.carry_over outputs/evaluate/RUN [RUN ...] --name general=agent_general \
        --report docs/carry_over.md --table seed_0

Joins the ``episodes.parquet`` of the folders. The first table has every driver's paired lead over
MOBIL on the same episodes (mean and bootstrap interval, 95 %), the second what went wrong: hard
crashes, departures from the road, and dangerous closeness to somebody behind per episode.
``--report`` puts both between the marker lines ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``
of a document, ``--table`` names them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from benchmarks.script import ReportSection, make_parser, run_script
from ganlane.errors import UserError
from ganlane.evaluation import evaluation_rows
from ganlane.evaluation.rows import paired_lead
from ganlane.evaluation.table import Table

BASELINE = "mobil"
KEY = ["agent", "traffic", "seed", "episode"]
COUNTED = ("hard_crash", "out_of_road")


def read(folders: Sequence[Path], names: Mapping[str, str]) -> pl.DataFrame:
    """The episodes of all folders, one row each; agents given by a path under their new names.

    Raises:
        UserError: a folder without episodes.
    """
    frames = []
    for folder in folders:
        path = folder / "episodes.parquet"
        if not path.is_file():
            raise UserError(
                f"{folder}: no episodes.parquet; give the folder of a finished 'ganlane evaluate'."
            )
        frame = pl.read_parquet(path)
        frames.append(
            frame.with_columns(pl.col("agent").replace({old: new for new, old in names.items()}))
        )
    return pl.concat(frames, how="diagonal").unique(KEY, keep="first", maintain_order=True)


def lead_cell(driver: pl.DataFrame, baseline: pl.DataFrame) -> str:
    """Mean reward of the baseline itself; of others their paired lead over it."""
    if driver["agent"][0] == BASELINE:
        (row,) = evaluation_rows(driver)
        return f"({row['mean_reward']:.1f})"
    lead, shared = paired_lead(driver, baseline)
    if lead is None or lead.interval is None:
        return "-"
    low, high = lead.interval
    fewer = "" if shared == baseline.height else f" ({shared})"
    text = f"{lead.value:+.1f} [{low:.1f}, {high:.1f}]{fewer}"
    return f"**{text}**" if low > 0.0 else text


def failure_cell(driver: pl.DataFrame) -> str:
    """Hard crashes, departures from the road, and soft crashes behind per episode."""
    crashes, departures = (int((driver["reason"] == reason).sum()) for reason in COUNTED)
    return f"{crashes}, {departures}, {driver['soft_crash_behind'].sum() / driver.height:.2f}"


def tables(episodes: pl.DataFrame) -> str:
    """Both tables, drivers by traffics, in the order in which they first appear."""
    traffics = episodes["traffic"].unique(maintain_order=True).to_list()
    agents = episodes["agent"].unique(maintain_order=True).to_list()
    leads, failures = [], []
    for agent in agents:
        there = {traffic: _of(episodes, agent, traffic) for traffic in traffics}
        leads.append(
            [
                lead_cell(x, _of(episodes, BASELINE, traffic)) if x.height else ""
                for traffic, x in there.items()
            ]
        )
        failures.append([failure_cell(x) if x.height else "" for x in there.values()])
    counts = [str(_of(episodes, BASELINE, traffic).height) for traffic in traffics]
    return "\n".join(
        [
            "Paired lead over MOBIL in reward (for MOBIL its mean reward); bold: the interval is above 0:",
            "",
            _markdown(traffics, [["episodes", *counts], *_headed(agents, leads)]),
            "",
            "Hard crashes, departures from the road, soft crashes behind per episode:",
            "",
            _markdown(traffics, _headed(agents, failures)),
        ]
    )


def _of(episodes: pl.DataFrame, agent: str, traffic: str) -> pl.DataFrame:
    return episodes.filter((pl.col("agent") == agent) & (pl.col("traffic") == traffic))


def _markdown(traffics: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return Table("", ["driver", *traffics], lines).markdown(heading=False)


def _headed(agents: Sequence[str], cells: Sequence[Sequence[str]]) -> list[list[str]]:
    return [[f"`{agent}`", *line] for agent, line in zip(agents, cells)]


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="of finished 'ganlane evaluate' runs")
    parser.add_argument(
        "--name", action="append", default=[], help="NEW=OLD: another name for an agent"
    )
    parser.add_argument("--report", type=Path, help="document with the marker lines")
    parser.add_argument("--table", default="table", help="name of the markers")
    return parser.parse_args(arguments)


def report(options: argparse.Namespace) -> str:
    """The tables, in the document too where one is named."""
    section = ReportSection(
        options.report, *(f"<!-- {options.table}: {which} -->" for which in ("begin", "end"))
    )
    text = tables(read(options.folders, dict(name.split("=", 1) for name in options.name)))
    section.write(text)
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, and write them where asked; the exit status."""
    return run_script(report, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
