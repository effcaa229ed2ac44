"""How fast it is, compared with a peer in the same run.

    python -m benchmarks.speed --suite sim --report docs/speed.md
    python -m benchmarks.speed --suite gymnasium --report docs/speed.md
    python -m benchmarks.speed --suite scenarios --report docs/speed.md
    python -m benchmarks.speed --suite traffic --traffics gan gan_calibrated --modes eager native
    python -m benchmarks.speed --suite train --modes eager native --stored 100000 --seconds 2
    python -m benchmarks.speed --quick

sim: the simulator, bare and as a whole environment through TorchRL, beside HighwayEnv; gymnasium:
every traffic through gymnasium, with random actions and with an ego that keeps its lane to the
goal, beside EnvPool and HighwayEnv; scenarios: merging and taking an exit, beside their versions of
the same, an on-ramp beside SUMO's, each beside a highway with as many vehicles; traffic: every
traffic model; train: the training loop, beside stable-baselines3's DQN on HighwayEnv. Peers are
measured where they are installed. A report of a GPU is the section `bench SUITE cuda`.
"""

from __future__ import annotations

import argparse
import itertools
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import date
from functools import partial

from benchmarks.script import (
    ReportSection,
    add_report,
    count,
    make_parser,
    markdown,
    run_script,
    significant,
)
from benchmarks.speed import systems
from benchmarks.speed.measure import Case, Labels, Row, Runner, measure
from benchmarks.speed.sumo import start_on_ramp
from benchmarks.speed.systems import Road, installed_version
from ganlane.agents import RainbowConfig
from ganlane.evaluation import machine_sentence
from ganlane.evaluation.table import Cell, Table, text_of

#: Defaults of each suite: batches and traffics.
BATCHES = {
    "sim": [1, 16, 64, 256, 1024, 4096],
    "gymnasium": [1, 16, 256, 1024, 4096],
    "scenarios": [1, 256],
    "traffic": [512, 2048],
    "train": [256, 512, 1024],
}
TRAFFICS = {
    "sim": ["idm_mobil"],
    "gymnasium": ["idm", "idm_mobil", "idm_faults", "idm_random", "human", "gan", "gan_calibrated"],
    "scenarios": ["idm_mobil"],
    "traffic": ["idm", "idm_mobil", "gan", "gan_calibrated"],
    "train": ["idm_mobil", "gan"],
}
#: What the egos of the suite gymnasium do, and whether they keep their lanes.
EGOS = {"random actions": False, "keeping its lane": True}
#: Of the suite scenarios.
SCENES = ("merge", "exit", "on_ramp")
#: Suites that go through gymnasium.
THROUGH_GYMNASIUM = ("gymnasium", "scenarios")
#: Heading to cell of the tables' columns.
COLUMNS: dict[str, Cell] = {
    **{name: text_of(name) for name in ("system", "traffic", "mode", "device", "threads", "batch")},
    "physics steps/s": lambda row: count(row["physics_steps_per_s"]),
    "decisions/s": lambda row: count(row["decisions_per_s"]),
    "physics steps/CPU-s": lambda row: count(row["physics_steps_per_cpu_s"]),
    "times the peer": lambda row: significant(row["ratio"]),
    "in CPU time": lambda row: significant(row["ratio_cpu"]),
    "spread": lambda row: f"{100 * row['spread']:.0f} %",
}


def cases_of(
    options: argparse.Namespace, road: Road, threads: int, batch: int, ego: str
) -> list[Case]:
    """What takes turns in one group: every system, traffic and mode of the suite."""
    starts: dict[str, Callable[..., Runner]]
    if options.suite == "sim":
        starts = {
            "ganlane physics": systems.start_physics,
            "ganlane environment": systems.start_environment,
        }
    elif options.suite == "traffic":
        starts = {"ganlane traffic": systems.start_traffic}
    elif options.suite == "train":
        start = partial(systems.start_training, config=RainbowConfig(), stored=options.stored)
        starts = {"ganlane training": start}
    else:
        start = partial(systems.start_gymnasium, keep=EGOS[ego])
        starts = {f"ganlane{_scene_and_ego(road, ego)}": start}
        if options.suite == "scenarios":
            # What the ends of lanes cost.
            name = f"ganlane highway with as many vehicles, {ego}"
            starts[name] = partial(systems.start_without_ends, start)
    cases = []
    for traffic, system, mode in itertools.product(options.traffics, starts, options.modes):
        labels = Labels(
            system, traffic, road.vehicles, road.lanes, mode, options.device, threads, batch
        )
        start = partial(starts[system], replace(road, traffic=traffic), mode, options.device, batch)
        cases.append(Case(labels, start, batch))
    return cases


def _scene_and_ego(road: Road, ego: str) -> str:
    """For the name of a system."""
    scene = "" if road.scene == "highway" else f" {road.scene}"
    return f"{scene}, {ego}" if ego else scene


def peers_of(
    options: argparse.Namespace, road: Road, threads: int, batch: int, ego: str
) -> list[Case]:
    """The peers of a group that are installed; ratios are to the first."""
    if options.no_peers or options.suite == "traffic":
        return []
    # Neither HighwayEnv nor EnvPool has an on-ramp where others merge.
    name, package = "HighwayEnv", "highway-env"
    if road.scene == "on_ramp":
        name, package = "SUMO", "libsumo"
    installed = installed_version(package)
    if installed is None:
        print(f"left out, {name}: pip install 'ganlane[bench]' brings it.", file=sys.stderr)
        return []
    driven = _scene_and_ego(road, ego)
    keep = EGOS.get(ego, False)

    def case(
        system: str, start: Callable[[], Runner], mode: str, rows: int = 1, changes: str = "MOBIL"
    ) -> Case:
        place = road.vehicles, road.lanes, mode, "cpu", threads, rows
        return Case(Labels(system, f"its IDM and {changes}", *place), start, rows)

    system = f"{name} {installed}{driven}"
    if road.scene == "on_ramp":
        start = partial(start_on_ramp, keep)
        return [case(system, start, "native", changes="LC2013")]
    if options.suite == "train":
        learner = installed_version("stable-baselines3")
        if learner is None:
            return []
        agent = RainbowConfig()
        name = f"stable-baselines3 {learner} DQN on {system}"
        baseline = case(name, partial(systems.start_baseline, road, agent), "eager")
        return [baseline._replace(decisions_per_call=agent.decisions_per_update)]
    peers = [case(system, partial(systems.start_highway, road, keep), "eager")]
    envpool = installed_version("envpool")
    if options.suite in THROUGH_GYMNASIUM and envpool is not None:
        start = partial(systems.start_envpool, road, batch, threads, keep)
        peers.insert(0, case(f"EnvPool {envpool}{driven}", start, "native", batch))
    return peers


def rows_of(options: argparse.Namespace) -> list[Row]:
    """Rows of all groups, each group's peers first."""
    road = Road(options.traffics[0], options.vehicles, options.lanes)
    roads = [road]
    if options.suite == "scenarios":
        roads = [road.with_scene(scene) for scene in SCENES]
    rows = []
    egos = list(EGOS) if options.suite in THROUGH_GYMNASIUM else [""]
    groups = itertools.product(options.threads, options.batches, roads, egos)
    for threads, batch, road, ego in groups:
        cases = cases_of(options, road, threads, batch, ego)
        peers = peers_of(options, road, threads, batch, ego)
        rows += measure(peers, cases, options.repetitions, options.seconds)
        where = f"threads {threads}, batch {batch}{_scene_and_ego(road, ego)}"
        print(f"{where}: done", file=sys.stderr, flush=True)
    return rows


def table_of(rows: Sequence[Row]) -> Table:
    """A line for every case."""
    places = {f"{row['vehicles']} vehicles on {row['lanes']} lanes": None for row in rows}
    place = ", ".join(places)
    note = "Medians; spread is the interquartile range of the wall time over its median."
    return Table.of(f"Speed, {place}", rows, COLUMNS, 4, [note])


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    add = parser.add_argument
    add("--suite", choices=tuple(BATCHES), default="sim")
    add("--quick", action="store_true", help="a check that it runs: small batches, short turns")
    add("--traffics", nargs="+", metavar="NAME", help="options of the group traffic")
    add("--batches", nargs="+", type=int, metavar="N", help="environments side by side")
    modes = ["eager", "native"]
    add("--modes", nargs="+", choices=modes, default=modes)
    add("--threads", nargs="+", type=int, default=[1], metavar="N", help="of torch")
    add("--device", choices=("cpu", "cuda"), default="cpu")
    add("--vehicles", type=int, default=9, metavar="N", help="the ego included")
    add("--lanes", type=int, default=3, metavar="N")
    add("--stored", type=int, default=1_000_000, metavar="N",
        help="suite train: transitions in the replay buffer when the clock starts")  # fmt: skip
    add("--repetitions", type=int, default=5, metavar="N", help="turns of every case")
    add("--seconds", type=float, default=0.5, help="a turn lasts about so long")
    add("--no-peers", action="store_true")
    add_report(parser, "bench SUITE")
    options = parser.parse_args(arguments)
    options.traffics = options.traffics or TRAFFICS[options.suite]
    if options.suite in THROUGH_GYMNASIUM:
        options.modes = ["native"]
    options.batches = options.batches or BATCHES[options.suite]
    if options.quick:
        options.batches = [min(*options.batches, 64)]
        options.stored = min(options.stored, 1000)
        options.repetitions, options.seconds = 2, 0.01
    options.told = shlex.join(sys.argv[1:] if arguments is None else arguments)
    return options


def compare(options: argparse.Namespace) -> str:
    """Measure all; the table, in the document too where one is named."""
    name = options.suite if options.device == "cpu" else f"{options.suite} {options.device}"
    section = ReportSection(options.report, f"bench {name}")
    table = table_of(rows_of(options))
    taken = f"Taken on {date.today()}: {machine_sentence(options.threads)}"
    command = f"    python -m benchmarks.speed {options.told}".rstrip()
    section.write("\n\n".join([command, taken, markdown(table)]))
    return table.text()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(compare, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
