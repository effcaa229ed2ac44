"""Drive the matrix of drivers and traffics, and write the paper's tables and figures."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import polars as pl
from matplotlib.figure import Figure

from ganlane.agents import read_agent
from ganlane.agents.checkpoint import save_agents, with_seeds
from ganlane.errors import UserError
from ganlane.evaluation import failed_episodes, machine_sentence, write_results
from ganlane.reproduce import figures as drawings
from ganlane.reproduce import report
from ganlane.reproduce.cells import available, cells_of, drive, read_cells
from ganlane.reproduce.crashes import find_crashes, write_crashes
from ganlane.settings.commands import ReproduceConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.torch_settings import set_threads

#: Hours that one training of the paper's schedule took, on one core.
HOURS_PER_SEED = 1.1
#: Pairs of drivers that the paper's claims are about, and ours.
PAIRS = (
    ("agent_gan", "mobil"),
    ("agent_gan", "agent_idm"),
    ("agent_idm", "mobil"),
    ("agent_gan", "agent_idm_long"),
    ("agent_idm_long", "agent_idm"),
    ("agent_gan", "agent_gan_only"),
    ("agent_gan_only", "mobil"),
    ("agent_idm_table3", "agent_idm"),
    ("agent_gan_table3", "agent_gan"),
    ("agent_gan_table3", "agent_idm_table3"),
    ("agent_gan+safe", "agent_idm+safe"),
    ("agent_general", "mobil"),
    ("agent_general", "mobil_egoistic"),
    ("agent_general", "agent_gan"),
    ("agent_general", "agent_idm+safe"),
    ("agent_general", "agent_gan+safe"),
)


def reproduce(config: ReproduceConfig, folder: Path) -> str:
    """Drive what is missing, then write numbers, tables and figures.

    The line that names the report.
    """
    set_threads(config.threads)
    if config.source == "scratch":
        config = trained_from_scratch(config)
    # A folder that cannot be read shows before hours of driving.
    curves = drawings.read_curves(config.runs)
    traffics, missing = available(config)
    _print_left_out(missing)
    cells = cells_of(config, traffics)
    drive(cells, config)
    episodes, revisions, seconds = read_cells(cells)
    # From here on nothing is driven but the figure of an episode and the list of crashes.
    by_recipe = report.by_recipe(episodes)
    rows = report.rows(by_recipe)
    compared = report.comparisons(by_recipe, _pairs(by_recipe))
    tables = {
        "table_vi": report.table_vi(rows),
        "table_vii": report.table_vii(rows),
        "comparisons": report.comparison_table(compared),
        "matrix": report.matrix_table(rows),
    }
    numbers, figures, not_drawn = _figures(config, traffics)
    figures = {"matrix": drawings.draw_matrix(rows), **figures}
    # Figure 4 needs the metrics of training runs; without them it is left out.
    if curves is not None:
        numbers["figure_4"] = curves
        figures["figure_4"] = drawings.draw_transfer(curves, rows)
    _print_left_out(not_drawn)
    missing |= not_drawn
    # The rows behind two of the tables say more than what is printed of them.
    files: dict[str, Any] = {
        **tables,
        "comparisons": compared,
        "matrix": rows,
        **numbers,
    }
    for name, content in files.items():
        report.write_csv(folder / f"{name}.csv", content)
    driven = {name: config.episodes_on(name) for name in traffics}
    counts = ", ".join(f"{count} on {name}" for name, count in driven.items())
    intro = [
        f"Episodes of seed {config.seed}, the same for all drivers: {counts}. Intervals are 95 %: "
        "over trainings, where there are several of a recipe, and over episodes.",
        *(f"Left out, {name}: {reason}" for name, reason in missing.items()),
        f"Driving took {sum(seconds.values()) / 60:.1f} minutes of one process.",
        machine_sentence([config.threads or 1]),
    ]
    page = report.write_report(
        folder,
        tables,
        figures,
        intro,
    )
    for table in tables.values():
        print(table.text(), end="\n\n")
    if config.crashes:
        _list_crashes(episodes, config, folder)
    # Where the episodes of every pair lie, for whoever wants to look closer.
    names = {f"{cell.driver} on {cell.traffic}": cell.path.name for cell in cells}
    record = {
        "rows": rows,
        "comparisons": compared,
        "failures": failed_episodes(episodes),
        "left_out": missing,
        "seconds": seconds,
        "cells": {"revisions": revisions, "files": names},
    }
    seeds = {
        "stream": config.stream,
        "seed": config.seed,
        "episodes": driven,
    }
    return f"report: {page}; results: {write_results(folder, record, asdict(config), seeds)}"


def _figures(
    config: ReproduceConfig, traffics: Mapping[str, TrafficConfig]
) -> tuple[dict[str, pl.DataFrame], dict[str, Figure], dict[str, str]]:
    """Figures 2 and 3: the numbers behind them, themselves, and why one is missing; by name."""
    numbers = {}
    figures = {}
    missing = {}
    # Without the recordings there is no figure 2, but everything else.
    try:
        numbers["figure_2"] = drawings.forecasts_to_draw()
        figures["figure_2"] = drawings.draw_forecasts(numbers["figure_2"])
    except UserError as error:
        missing["figure 2"] = str(error)
    if "gan" in traffics:
        episode = drawings.drive_beginning(config, traffics["gan"])
        numbers["figure_3"] = drawings.busiest(episode)
        figures["figure_3"] = drawings.draw_episode(
            episode.label,
            numbers["figure_3"],
        )
    else:
        missing["figure 3"] = "the traffic gan is not among the traffics"
    return numbers, figures, missing


def _print_left_out(missing: Mapping[str, str]) -> None:
    for name, reason in missing.items():
        print(f"left out, {name}: {reason}", file=sys.stderr)


def _list_crashes(
    episodes: pl.DataFrame,
    config: ReproduceConfig,
    folder: Path,
) -> None:
    """Write the earliest crashes of every driver but the controls, as ``crashes.json``."""
    # Who drives at random crashes in most episodes, which shows nothing.
    controls = ["random", "random_legal", "keep_lane"]
    drivers = episodes.filter(~pl.col("agent").is_in(controls))
    listed, others = find_crashes(drivers, config, config.crashes)
    write_crashes(folder / "crashes.json", listed)
    print(
        f"crashes.json: {len(listed.crashes)} crashes; {others} ended otherwise when driven again, "
        "not listed"
    )


def _pairs(by_recipe: report.Cells) -> list[tuple[str, str]]:
    """:data:`PAIRS` by the names of the drivers here.

    ``agent_idm+none`` may stand for ``agent_idm``, and ``agent_general+safe`` for
    ``agent_general``.
    """
    names = {recipe for recipe, _ in by_recipe}

    def here(name: str) -> str:
        # The report may name a driver with its mask: safe for agent_general, none for others.
        mask = "safe" if name == "agent_general" else "none"
        return name if name in names else f"{name}+{mask}"

    return [(here(one), here(other)) for one, other in PAIRS]


def trained_from_scratch(config: ReproduceConfig) -> ReproduceConfig:
    """Train the paper's schedule for every seed, and take those agents for the ones that ship.

    Raises:
        UserError: a training did not end well; its own sentence stands above.
    """
    for name in config.agents:
        with_seeds(name)  # a training that is not installed shows before hours of training
    # A finished training has results.json; it is not made again.
    folders = {seed: Path(config.trained) / f"seed_{seed}" for seed in config.training_seeds}
    to_train = [seed for seed, path in folders.items() if not (path / "results.json").is_file()]
    print(
        f"{len(to_train)} trainings, one after the other: about "
        f"{HOURS_PER_SEED * len(to_train):.1f} hours on one core.",
        file=sys.stderr,
    )
    for seed in to_train:
        path = folders[seed]
        arguments = ["experiment=paper", f"seed={seed}", f"hydra.run.dir={path}"]
        # A training that was stopped goes on where it was.
        if any(path.rglob("last.pt")):
            arguments = [f"resume={path}"]
        # A process of its own: a training sets threads and seeds for itself.
        command = [
            sys.executable,
            "-m",
            "ganlane.train",
            *arguments,
        ]
        if subprocess.run(command, check=False).returncode:
            raise UserError(
                f"source=scratch: the training in {path} stopped; the same command goes on with it."
            )
    agents = config.agents
    for recipe, phase in (("agent_idm", "pretrain"), ("agent_gan", ".")):
        file = Path(config.trained) / f"{recipe}.safetensors"
        # Agent_IDM is what the first phase gave, Agent_GAN what the second one did.
        trained = {
            seed: read_agent(path / phase / "agent.safetensors") for seed, path in folders.items()
        }
        save_agents(file, trained)
        # The fresh files take the place of those that ship, under the same masks.
        agents = [name.replace(f"{recipe}@all", f"{file}@all") for name in agents]
    return replace(
        config,
        agents=agents,
        runs=[str(path) for path in folders.values()],
    )
