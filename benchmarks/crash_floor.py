"""Upper bound on the share of crashes that no driver could have avoided, by beam search on the
simulator itself.

    python -m benchmarks.crash_floor --traffic gan --episodes 300 --beam 8 32 128 --report
    docs/results.md

An episode counts as avoidable once some sequence of actions brings the ego through it without a
hard crash. First ordinary drivers drive the first episodes of the report stream, which costs
little. Those in which all of them crashed are searched with beams of growing size
(:mod:`benchmarks.beam_search`), and a sequence that a search found is driven again before it
counts. What is left is an upper bound of the unavoidable share, and it falls with the beam.

The bound belongs to a driver who knows what comes and who, like every driver here, decides on lanes
alone: the ego's speed is IDM's. Who does not know what comes will do worse.

Writes results.json, with the actions of every way that was found, into its folder; with --report
also the tables between the markers of a document.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from benchmarks.beam_search import beam_search
from benchmarks.script import ReportSection, add_report, make_parser, run_script
from ganlane.api import load_agent, make_env
from ganlane.evaluation import clopper_pearson, write_results
from ganlane.evaluation.episodes import SIDES, Rollout, replay, roll_out
from ganlane.evaluation.table import Table
from ganlane.runtime import keep_freed_memory

DRIVERS = ("mobil", "agent_idm", "keep_lane")
#: The first stage: rides of ordinary drivers. The others are named after their beams.
FIRST_STAGE = "drivers"


@dataclass(frozen=True)
class Way:
    """A way through an episode; where none was found, one to a crash.

    Attributes:
        stage: ``drivers`` or ``beam K``: what found it; None where nobody came through.
        ride: with the actions; None where nobody has driven this episode yet.
        widest: most states alive at once in the last search; 0 where there was none. Below the
            beam, the search dropped nothing but like states.
    """

    episode: int
    stage: str | None = None
    ride: Rollout | None = None
    widest: int = 0


def stage_of(beam: int) -> str:
    """The name of the search with ``beam``."""
    return f"beam {beam}"


def ways_of_drivers(driven: Iterable[Sequence[Rollout]], episodes: Sequence[int]) -> list[Way]:
    """Which of ``episodes`` ordinary drivers came through, by the ride with the highest return.

    One way each.
    """
    best: dict[int, Rollout] = {}
    for ride in sorted(
        (ride for rides in driven for ride in rides), key=lambda ride: (ride.safe, ride.reward)
    ):
        best[ride.episode] = ride
    rides = [(number, best.get(number)) for number in episodes]
    return [
        Way(number, FIRST_STAGE if ride is not None and ride.safe else None, ride)
        for number, ride in rides
    ]


def search_left(env: EnvBase, ways: Sequence[Way], seed: int, beam: int) -> list[Way]:
    """``ways`` with those of episodes of ``seed`` that had none searched for, and driven again, in
    ``env``.
    """
    left = [way.episode for way in ways if way.stage is None]
    if not left:
        return list(ways)
    plans = {plan.episode: plan for plan in beam_search(env, left, seed, beam)}
    rides = replay(env, {number: plan.actions for number, plan in plans.items()}, seed)
    stages = {ride.episode: stage_of(beam) if ride.safe else None for ride in rides}
    found = {
        r.episode: Way(r.episode, stages[r.episode], r, plans[r.episode].widest) for r in rides
    }
    return [found.get(way.episode, way) for way in ways]


def floor_rows(ways: Sequence[Way], beams: Sequence[int]) -> list[dict[str, Any]]:
    """Per stage.

    ``searched_with, avoidable, not_avoided`` (counts so far), ``share, share_ci`` (exact, 95 %).
    """
    rows, avoidable = [], 0
    for stage in (FIRST_STAGE, *map(stage_of, beams)):
        avoidable += sum(way.stage == stage for way in ways)
        share = clopper_pearson(len(ways) - avoidable, len(ways))
        left = {"avoidable": avoidable, "not_avoided": len(ways) - avoidable}
        rows.append(
            {"searched_with": stage, **left, "share": share.value, "share_ci": share.interval}
        )
    return rows


def driver_row(name: str, rides: Sequence[Rollout], ways: Sequence[Way]) -> dict[str, Any]:
    """A driver's crashes.

    How many, which of them were avoidable, what they hit and whether the ego kept its lane.
    """
    crashes = [ride for ride in rides if ride.end == "hard_crash"]
    avoidable = {way.episode for way in ways if way.stage is not None}
    share = clopper_pearson(len(crashes), len(rides))
    return {
        "driver": name,
        "episodes": len(rides),
        "hard_crash": len(crashes),
        "share": share.value,
        "share_ci": share.interval,
        "avoidable": sum(ride.episode in avoidable for ride in crashes),
        **{side: sum(ride.contact == side for ride in crashes) for side in SIDES[1:]},
        "keeping_lane": sum(not ride.changing for ride in crashes),
        "keeping_lane_hit_from_side_or_behind": sum(
            not ride.changing and ride.contact in ("side", "behind") for ride in crashes
        ),
        "mean_reward": sum(ride.reward for ride in rides) / len(rides),
    }


def rides_of(name: str, options: argparse.Namespace) -> list[Rollout]:
    """The rides of one driver."""
    driver, begun = load_agent(name, vehicles=options.vehicles), time.monotonic()
    env = environment(options, driver.observation)
    rides = roll_out(env, driver.policy, range(options.episodes), options.seed)
    line = f"{name}: {options.episodes} episodes driven in {time.monotonic() - begun:.0f} s"
    print(line, file=sys.stderr, flush=True)
    return rides


def environment(options: argparse.Namespace, observation: Any = None) -> Any:
    """Rows of the same number everywhere, so that generated traffic rounds alike."""
    return make_env(
        options.traffic,
        options.rows,
        observation=observation,
        seed=options.seed,
        stream="report",
        vehicles=options.vehicles,
    )


def share(row: dict[str, Any]) -> str:
    """Per cent with the exact interval."""
    low, high = row["share_ci"]
    return f"{100 * row['share']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def floor_table(rows: Sequence[dict[str, Any]], episodes: int) -> Table:
    """What is left after each stage."""
    columns = {
        "after": lambda row: row["searched_with"],
        "a way through found": lambda row: f"{row['avoidable']} of {episodes}",
        "none found": lambda row: str(row["not_avoided"]),
        "share with none [95 %]": share,
    }
    return Table.of("", rows, columns)


def driver_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Whose crashes, and what they hit."""
    columns = {
        "driver": lambda row: row["driver"],
        "crashes [95 %]": lambda row: f"{row['hard_crash']}: {share(row)}",
        "avoidable": lambda row: str(row["avoidable"]),
        **{side: lambda row, side=side: str(row[side]) for side in ("ahead", "side", "behind")},
        "keeping its lane": lambda row: str(row["keeping_lane"]),
        "mean reward": lambda row: f"{row['mean_reward']:.1f}",
    }
    return Table.of("", rows, columns)


def written(way: Way) -> dict[str, Any]:
    """A way as it is kept: enough to drive it again."""
    ride = {} if way.ride is None else asdict(way.ride)
    return {"episode": way.episode, "found_by": way.stage, "widest": way.widest, **ride}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--traffic", default="gan")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--beam", type=int, nargs="+", default=[8, 32, 128], help="growing sizes")
    parser.add_argument(
        "--drivers", nargs="*", default=list(DRIVERS), help="none: search every episode"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--vehicles", type=int, default=9, help="the ego included")
    parser.add_argument("--rows", type=int, default=32, help="highways that are stepped at once")
    parser.add_argument("--folder", type=Path, help="default: outputs/crash_floor/TRAFFIC")
    add_report(parser, *markers("TRAFFIC"))
    return parser.parse_args(arguments)


def markers(traffic: str) -> tuple[str, str]:
    """Lines of the document between which the tables of this traffic stand."""
    return f"<!-- begin crash floor {traffic} -->", f"<!-- end crash floor {traffic} -->"


def publish(
    options: argparse.Namespace, section: ReportSection, tables: dict[str, Any], ways: Sequence[Way]
) -> str:
    """Print the tables, write them, and with --report put them into the document.

    Where the results are.
    """
    both = floor_table(tables["floor"], options.episodes), driver_table(tables["drivers"])
    text = "\n\n".join(table.markdown(heading=False) for table in both)
    print(text, flush=True)
    section.write(f"\n{text}\n")
    seeds = {"stream": "report", "seed": options.seed, "episodes": [0, options.episodes - 1]}
    numbers = {**tables, "ways": [written(way) for way in ways]}
    folder = options.folder or Path("outputs/crash_floor") / options.traffic
    return f"results: {write_results(folder, numbers, vars(options), seeds)}"


def measure(options: argparse.Namespace) -> str:
    """Drive and search.

    The results are published after every stage, since the later ones take long.
    """
    keep_freed_memory()
    section = ReportSection(options.report, *markers(options.traffic))
    begun, line = time.monotonic(), ""
    driven = {name: rides_of(name, options) for name in options.drivers}
    ways, env = ways_of_drivers(driven.values(), range(options.episodes)), environment(options)
    for number, beam in enumerate((None, *options.beam)):
        ways = ways if beam is None else search_left(env, ways, options.seed, beam)
        tables = {
            "floor": floor_rows(ways, options.beam[:number]),
            "drivers": [driver_row(name, rides, ways) for name, rides in driven.items()],
            "seconds": time.monotonic() - begun,
        }
        line = publish(options, section, tables, ways)
    return line


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(measure, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
