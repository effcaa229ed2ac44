"""A benchmark from its drivers to its results: drive, score, print, write."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from ganlane.build import Driver, make_driver, make_drivers
from ganlane.errors import UserError
from ganlane.evaluation import failed_episodes, machine_sentence, write_results
from ganlane.evaluation.table import show
from ganlane.settings.suite import BenchmarkConfig
from ganlane.sim.random import Stream
from ganlane.suite import report, scores
from ganlane.suite.driving import available, drive_episode, drive_suite
from ganlane.view.player import player_page

#: What a film shows of a failure: so many seconds before it.
_SHOWN_S = 15.0
#: Version of the form of ``results.json``: what is in it, by what name (docs/benchmark.md).
SCHEMA = 1
#: So many episodes of each driver and traffic are in ``results.json`` one by one.
SAMPLE = 5


def drivers_of(names: Sequence[str], config: BenchmarkConfig) -> list[Driver]:
    """The drivers of entries by their names; a folder stands for the trainings in it.

    Args:
        names: of drivers, as a command takes them, files, or folders of a training or a sweep.
        config: the suite, whose road and vehicles a driver has to fit.

    Raises:
        UserError: no such driver, a folder without agents, or one that does not fit.
    """
    env = config.suite.env
    stream = Stream.named(config.suite.stream)

    drivers: list[Driver] = []
    for name in names:
        folder = Path(name)
        if not folder.is_dir():
            drivers += make_drivers([name], env, config.device, stream)
            continue

        # Of a run its own agent, of a sweep those of its runs; a stable-baselines3 model each.
        places = ("agent.safetensors", "*/agent.safetensors", "*.zip")
        files = sorted(path for place in places for path in folder.glob(place))
        if not files:
            raise UserError(
                f"{name}: no agent.safetensors and no .zip in this folder or its runs; give the "
                "folder of a training, of a sweep, or a file."
            )

        # All agents of a folder are trainings of one recipe, which has the folder's name.
        recipe = folder.resolve().name
        for number, file in enumerate(files):
            driver = make_driver(str(file), env, stream, config.device)
            drivers.append(driver.renamed(f"{recipe}@{number}"))
    return drivers


def run(agents: Sequence[Driver], config: BenchmarkConfig, folder: Path) -> str:
    """Drive ``agents`` and the drivers of the suite, print the table, write results and report.

    Args:
        agents: the entries; trainings of one recipe are one.
        config: the suite, and how it is driven.
        folder: of the run; ``results.json`` and ``report.html`` go there.

    Returns:
        The line that names both files.
    """
    suite = config.suite
    scored = list(suite.scored)

    # Only traffics that the score does not need can be left out, say for want of a simulator.
    traffics, left_out = available(config)
    for name, reason in left_out.items():
        print(f"left out, {name}: {reason}", file=sys.stderr)

    # A driver of the suite that was entered as an agent drives once. The suite's come first, since
    # the order of the results is that of the drivers.
    entered = {driver.name for driver in agents}
    missing = [name for name in suite.drivers() if name not in entered]
    drivers = [*drivers_of(missing, config), *agents]
    episodes, seconds = drive_suite(drivers, traffics, config)

    # From one row per episode to numbers by traffic, and from these to numbers over traffics.
    by_recipe = scores.by_recipe(episodes)
    matrix = scores.rows(by_recipe)
    entries = scores.summaries(by_recipe, matrix, suite)

    # The speed of a recipe is that of all its trainings, on all traffics.
    for entry in entries:
        trainings = [name for name in seconds if scores.recipe_of(name) == entry["entry"]]
        took_s = sum(seconds[name] for name in trainings)
        theirs = episodes.filter(pl.col("agent").is_in(trainings))
        entry["decisions_per_s"] = int(theirs["decisions"].sum()) / took_s

    # Every agent against every driver of the suite, then the suite's pairs, each pair once.
    recipes = dict.fromkeys(scores.recipe_of(driver.name) for driver in agents)
    pairs = [(recipe, other) for recipe in recipes for other in suite.drivers() if recipe != other]
    pairs += [(first, second) for first, second in suite.pairs]
    compared = scores.comparisons(by_recipe, list(dict.fromkeys(pairs)))

    # The hash of the protocol tells whether two scores may be compared.
    quick = ", quick" if config.quick else ""
    title = f"{suite.version}{quick}, protocol {config.protocol()}"
    scale = f"score 0 random_legal, 100 mobil; interquartile mean over {', '.join(scored)}"
    # Below the table: what the columns are of.
    notes = [
        f"{title}: {scale}.",
        "crashes, off road, at fault, near misses: per 1000 km of all these traffics.",
    ]
    table = report.score_table(entries, scored, notes)

    # Under another protocol the paper's numbers are no comparison.
    paper = report.paper_tables(matrix) if suite.version == "paper" else []

    show(table.text(), *(further.text() for further in paper), columns=config.columns)

    # How many episodes of each traffic a training drove: fewer than asked for where a replayed
    # traffic has no more starts.
    driven = {row["traffic"]: row["episodes"] for row in matrix}
    counts = ", ".join(f"{count} on {name}" for name, count in driven.items())
    intro = [
        "Intervals are 95 %: over trainings, where there are several of a recipe, and over "
        "episodes.",
        f"Episodes of seed {config.seed}, the same for all drivers: {counts}",
        *(f"Left out, {name}: {reason}" for name, reason in left_out.items()),
        machine_sentence([config.threads or 1]),
    ]

    # The page holds all tables, the terminal only the first ones.
    films = _films(agents, episodes, config) if config.films else {}
    tables = [
        table,
        *paper,
        report.matrix_table(matrix),
        report.comparison_table(compared),
    ]
    page = report.write_report(folder, f"ganlane benchmark: {title}", tables, intro, films)

    # The form of this record is docs/results.schema.json; see SCHEMA.
    record = {
        "schema": SCHEMA,
        "suite": suite.version,
        "protocol": config.protocol(),
        "quick": config.quick,
        # Over traffics, by traffic, and by pair.
        "entries": entries,
        "rows": matrix,
        "comparisons": compared,
        # What anybody can drive again.
        "failures": failed_episodes(episodes),
        "sample": _sample(episodes, scored),
        "left_out": left_out,
    }
    # With these numbers every episode can be driven again.
    seeds = {
        "stream": suite.stream,
        "seed": config.seed,
        "episodes": driven,
    }
    results = write_results(folder, record, config, seeds)
    return f"report: {page}; results: {results}"


def _sample(episodes: pl.DataFrame, traffics: Sequence[str]) -> dict[str, Any]:
    """The rewards of the first episodes, by driver and traffic, for whoever drives them again.

    Lists of at most :data:`SAMPLE` undiscounted returns, on the ``traffics`` of the score alone.
    """
    sample: dict[str, Any] = {}
    for (driver, traffic), driven in episodes.group_by("agent", "traffic", maintain_order=True):
        if traffic in traffics:
            rewards = driven.sort("episode")["reward"].head(SAMPLE).to_list()
            sample.setdefault(str(driver), {})[str(traffic)] = rewards
    return sample


def _films(
    agents: Sequence[Driver],
    episodes: pl.DataFrame,
    config: BenchmarkConfig,
) -> dict[str, str]:
    """Pages that play the last seconds of the first failures of every entry, by their headings.

    At most ``config.films`` failures of each; an entry without failures has no page.
    """
    traffics = config.suite.traffics()

    pages = {}
    for driver in agents:
        # Number and traffic of every failure: one traffic after the other, on each crashes first.
        failures = []
        for row in failed_episodes(episodes.filter(pl.col("agent") == driver.name)):
            for number in [*row["hard_crash"], *row["out_of_road"]]:
                failures.append((number, row["traffic"]))

        shown = []
        for number, traffic in failures[: config.films]:
            # Driven again, which gives the same episode; positions were not stored.
            film = drive_episode(driver, traffics[traffic], config.on(traffic), number)
            begins_s = float(film.time_s[-1]) - _SHOWN_S
            shown.append(film.since(max(0.0, begins_s)))

        if shown:
            pages[f"Failures of {driver.name}"] = player_page(shown)
    return pages
