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
from ganlane.compare import available, cells_of, drive, read_cells
from ganlane.settings.commands import ReproduceConfig
from ganlane.config.run import stored_command
from ganlane.errors import UserError
from ganlane.evaluation import failed_episodes, machine_sentence, write_results
from ganlane.evaluation.table import Table
from ganlane.reproduce import figures as drawings
from ganlane.reproduce import report
from ganlane.reproduce.crashes import find_crashes, write_crashes
from ganlane.reproduce.report import Row
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
    # a folder that cannot be read shows before hours of driving
    drawings.read_transfers(config.runs, [])
    traffics, missing = available(config)
    _print_left_out(missing)
    cells = cells_of(config, traffics)
    drive(cells, config)
    episodes, revisions, seconds = read_cells(cells)
    by_recipe = report.by_recipe(episodes)
    rows, compared = report.rows(by_recipe), report.comparisons(by_recipe, _pairs(by_recipe))
    tables = _tables(rows, compared, folder)
    figures, not_drawn = _figures(config, traffics, rows, folder)
    missing |= not_drawn
    counts = ", ".join(f"{config.episodes_on(name)} on {name}" for name in traffics)
    intro = [
        f"Episodes of seed {config.seed}, the same for all drivers: {counts}. Intervals are 95 %: over trainings, "
        "where there are several of a recipe, and over episodes.",
        *(f"Left out, {name}: {reason}" for name, reason in missing.items()),
        f"Driving took {sum(seconds.values()) / 60:.1f} minutes of one process.",
        machine_sentence([config.threads or 1]),
    ]
    page = report.write_report(folder, tables, figures, intro)
    for table in tables.values():
        print(table.text(), end="\n\n")
    _list_crashes(episodes, config, folder)
    record = {
        "command": stored_command(folder, "ganlane reproduce"),
        "rows": rows,
        "comparisons": compared,
        "failures": failed_episodes(episodes),
        "left_out": missing,
        "seconds": seconds,
        "cells": {
            "revisions": revisions,
            "files": {f"{c.driver} on {c.traffic}": c.path.name for c in cells},
        },
    }
    driven = {name: config.episodes_on(name) for name in traffics}
    seeds = {"stream": config.stream, "seed": config.seed, "episodes": driven}
    return f"report: {page}; results: {write_results(folder, record, asdict(config), seeds)}"


def _tables(rows: list[Row], compared: list[Row], folder: Path) -> dict[str, Table]:
    """The tables of the report by name; the rows behind them as CSV files in ``folder``."""
    tables = {
        "table_vi": report.table_vi(rows),
        "table_vii": report.table_vii(rows),
        "comparisons": report.comparison_table(compared),
        "matrix": report.matrix_table(rows),
    }
    files: dict[str, Any] = {**tables, "comparisons": compared, "matrix": rows}
    for name, lines in files.items():
        report.write_csv(folder / f"{name}.csv", lines)
    return tables


def _figures(
    config: ReproduceConfig, traffics: Mapping[str, Any], rows: list[Row], folder: Path
) -> tuple[dict[str, Figure], dict[str, str]]:
    """The figures of the report by name, and why others are missing.

    The numbers behind each as a CSV file.
    """
    drawn = drawings.draw_all(config, traffics)
    _print_left_out(drawn.missing)
    figures = {"matrix": drawings.draw_matrix(rows), **drawn.figures}
    for name, frame in drawn.numbers.items():
        report.write_csv(folder / f"{name}.csv", frame.to_dicts())
    transfer = drawings.read_transfers(config.runs, rows)
    if transfer is not None:
        figures["figure_4"] = drawings.draw_transfer(transfer)
        curves = [
            {"run": name, **row}
            for name, frame in transfer.runs.items()
            for row in frame.to_dicts()
        ]
        report.write_csv(folder / "figure_4.csv", curves)
    return figures, drawn.missing


def _print_left_out(missing: Mapping[str, str]) -> None:
    for name, reason in missing.items():
        print(f"left out, {name}: {reason}", file=sys.stderr)


def _list_crashes(episodes: pl.DataFrame, config: ReproduceConfig, folder: Path) -> None:
    """Write the earliest crashes of every driver but the controls, as ``crashes.json``."""
    if config.crashes:
        compared = episodes.filter(
            ~episodes["agent"].is_in(["random", "random_legal", "keep_lane"])
        )
        listed, others = find_crashes(compared, config, config.crashes)
        write_crashes(folder / "crashes.json", listed)
        print(
            f"crashes.json: {len(listed.crashes)} crashes; {others} ended otherwise when driven again, not listed"
        )


def _pairs(by_recipe: dict[tuple[str, str], Any]) -> list[tuple[str, str]]:
    """:data:`PAIRS` by the names of the drivers here, of which ``agent_idm+none`` may stand for
    ``agent_idm``.
    """
    names = {recipe for recipe, _ in by_recipe}
    explicit = {name: name if name in names else f"{name}+none" for pair in PAIRS for name in pair}
    explicit["agent_general"] = (
        "agent_general" if "agent_general" in names else "agent_general+safe"
    )
    return [(explicit[one], explicit[other]) for one, other in PAIRS]


def trained_from_scratch(config: ReproduceConfig) -> ReproduceConfig:
    """Train the paper's schedule for every seed, and put those agents in the place of the ones that
    ship.

    Raises:
        UserError: a training did not end well; its own sentence stands above.
    """
    for name in config.agents:
        with_seeds(name)  # a training that is not installed shows before hours of training
    folders = {seed: Path(config.trained) / f"seed_{seed}" for seed in config.training_seeds}
    open_ones = {
        seed: path for seed, path in folders.items() if not (path / "results.json").is_file()
    }
    hours = HOURS_PER_SEED * len(open_ones)
    print(
        f"{len(open_ones)} trainings, one after the other: about {hours:.1f} hours on one core.",
        file=sys.stderr,
    )
    for seed, path in open_ones.items():
        stopped = any(path.rglob("last.pt"))
        asked = (
            [f"resume={path}"]
            if stopped
            else ["experiment=paper", f"seed={seed}", f"hydra.run.dir={path}"]
        )
        if subprocess.run([sys.executable, "-m", "ganlane.train", *asked], check=False).returncode:
            raise UserError(
                f"source=scratch: the training in {path} stopped; the same command goes on with it."
            )
    agents = config.agents
    for recipe, phase in (("agent_idm", "pretrain"), ("agent_gan", ".")):
        file = Path(config.trained) / f"{recipe}.safetensors"
        save_agents(
            file,
            {
                seed: read_agent(path / phase / "agent.safetensors")
                for seed, path in folders.items()
            },
        )
        agents = [name.replace(f"{recipe}@all", f"{file}@all") for name in agents]
    return replace(config, agents=agents, runs=[str(path) for path in folders.values()])
