"""How many crashes could a driver have avoided who knows what comes? Beam search on the simulator itself.

    python benchmarks/crash_floor.py --traffic gan --episodes 300 --beam 8 32 128 --report docs/results.md

Drives the first episodes of the report stream with ordinary drivers, then searches those in which all of them
crashed for a way through (:mod:`ganlane.evaluation.crash_floor`). Writes results.json, with the actions of every way
that was found, into its folder; with --report also the tables between the markers of a document.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ganlane.api import load_agent, make_env
from ganlane.benchmarks.script import ReportSection, add_report, parser_of, run_script
from ganlane.evaluation import write_results
from ganlane.evaluation.crash_floor import Way, driver_row, floor_rows, search_left, ways_of_drivers
from ganlane.evaluation.rides import Ride, drive
from ganlane.memory import keep_freed_memory

DRIVERS = ("mobil", "agent_idm", "keep_lane")


def rides_of(name: str, told: argparse.Namespace) -> list[Ride]:
    """The rides of one driver."""
    driver, begun = load_agent(name, vehicles=told.vehicles), time.monotonic()
    env = environment(told, driver.observation)
    rides = drive(env, driver.policy, range(told.episodes), told.seed)
    print(f"{name}: {told.episodes} episodes driven in {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    return rides


def environment(told: argparse.Namespace, observation: Any = None) -> Any:
    """Rows of the same number everywhere, so that generated traffic rounds alike."""
    return make_env(
        told.traffic, told.rows, observation=observation, seed=told.seed, stream="report", vehicles=told.vehicles
    )


def share(row: dict[str, Any]) -> str:
    """Per cent with the exact interval."""
    low, high = row["share_ci"]
    return f"{100 * row['share']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def floor_table(rows: Sequence[dict[str, Any]], episodes: int) -> list[str]:
    """Lines of Markdown: what is left after each stage."""
    lines = ["| after | a way through found | none found | share with none [95 %] |", "| --- | ---: | ---: | ---: |"]
    cells = ((r["searched_with"], f"{r['avoidable']} of {episodes}", r["not_avoided"], share(r)) for r in rows)
    return lines + [f"| {a} | {b} | {c} | {d} |" for a, b, c, d in cells]


def driver_table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of Markdown: whose crashes, and what they hit."""
    columns = ("driver", "crashes [95 %]", "avoidable", "ahead", "side", "behind", "keeping its lane", "mean reward")
    lines = ["| " + " | ".join(columns) + " |", "| --- |" + " ---: |" * (len(columns) - 1)]
    for r in rows:
        counts = (r["avoidable"], r["ahead"], r["side"], r["behind"], r["keeping_lane"], f"{r['mean_reward']:.1f}")
        lines.append(f"| {r['driver']} | {r['hard_crash']}: {share(r)} | " + " | ".join(map(str, counts)) + " |")
    return lines


def written(way: Way) -> dict[str, Any]:
    """A way as it is kept: enough to drive it again."""
    ride = {} if way.ride is None else asdict(way.ride)
    return {"episode": way.episode, "found_by": way.stage, "widest": way.widest, **ride}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """What the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument("--traffic", default="gan")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--beam", type=int, nargs="+", default=[8, 32, 128], help="growing sizes")
    parser.add_argument("--drivers", nargs="*", default=list(DRIVERS), help="none: search every episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--vehicles", type=int, default=9, help="the ego included")
    parser.add_argument("--rows", type=int, default=32, help="highways that are stepped at once")
    parser.add_argument("--folder", type=Path, help="default: outputs/crash_floor/TRAFFIC")
    add_report(parser, *markers("TRAFFIC"))
    return parser.parse_args(arguments)


def markers(traffic: str) -> tuple[str, str]:
    """Lines of the document between which the tables of this traffic stand."""
    return f"<!-- begin crash floor {traffic} -->", f"<!-- end crash floor {traffic} -->"


def publish(told: argparse.Namespace, section: ReportSection, tables: dict[str, Any], ways: Sequence[Way]) -> str:
    """Print the tables, write them, and with --report put them into the document; where the results are."""
    text = "\n".join([*floor_table(tables["floor"], told.episodes), "", *driver_table(tables["drivers"])])
    print(text, flush=True)
    section.write(f"\n{text}\n")
    seeds = {"stream": "report", "seed": told.seed, "episodes": [0, told.episodes - 1]}
    numbers = {**tables, "ways": [written(way) for way in ways]}
    folder = told.folder or Path("outputs/crash_floor") / told.traffic
    return f"results: {write_results(folder, numbers, vars(told), seeds)}"


def measure(told: argparse.Namespace) -> str:
    """Drive and search; the results are published after every stage, since the later ones take long."""
    keep_freed_memory()
    section = ReportSection(told.report, *markers(told.traffic))
    begun, line = time.monotonic(), ""
    driven = {name: rides_of(name, told) for name in told.drivers}
    ways, env = ways_of_drivers(driven.values(), range(told.episodes)), environment(told)
    for number, beam in enumerate((None, *told.beam)):
        ways = ways if beam is None else search_left(env, ways, told.seed, beam)
        tables = {
            "floor": floor_rows(ways, told.beam[:number]),
            "drivers": [driver_row(name, rides, ways) for name, rides in driven.items()],
            "seconds": time.monotonic() - begun,
        }
        line = publish(told, section, tables, ways)
    return line


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(measure, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
