"""The numbers of the matrix with the training as the unit, tables beside the paper's, a page."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from ganlane.errors import UserError
from ganlane.evaluation.rows import FAILURES, SCALE_BOTTOM, SCALE_TOP
from ganlane.evaluation.statistics import (
    Array,
    Estimate,
    clopper_pearson,
    difference,
    entries,
    interquartile_mean,
    mcnemar,
    normalized_over_trainings,
    over_trainings,
    probability_of_improvement,
    rate_over_trainings,
)
from ganlane.evaluation.table import NOTHING, Cell, Table, number, number_of, text_of
from ganlane.files import atomic_path, write_bytes
from ganlane.view.figures import save_figure

Row = dict[str, Any]
#: Recipe and traffic to the episodes of each training, by driver's name.
Cells = Mapping[tuple[str, str], Mapping[str, pl.DataFrame]]
#: Rates per 1000 km by name: the ends that they count.
_RATES = {
    "crashes": FAILURES[:1],
    "departures": FAILURES[1:],
    "failures": FAILURES,
}
#: The paper's Table VI: hard and soft crashes on Traffic_IDM, of an unstated number of runs.
PAPER_VI = {
    "agent_idm": (19, 2),
    "agent_gan": (9, 0),
}
#: The paper's Table VII: % of MOBIL, mean reward and its standard deviation on Traffic_GAN, 1000
#: runs.
PAPER_VII = {
    "agent_idm": (5.21, -22.33, 100.66),
    "agent_gan": (114.82, 33.62, 95.19),
}
_CSS = """
body { font: 15px/1.5 sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; }
body { color: #262a30 }
table { border-collapse: collapse; font-size: 13px; margin: 1em 0 }
td, th { padding: 2px 9px; text-align: right }
th { border-bottom: 1px solid #6e747c }
th[scope] { border: 0; font-weight: normal; text-align: left }
svg { max-width: 100%; height: auto }
.wide { overflow-x: auto }
"""


def recipe_of(driver: str) -> str:
    """``agent_idm+safe`` of ``agent_idm@3+safe`` and of ``FOLDER/agent_idm.safetensors@3+safe``."""
    # Name, seed and mask: a folder and the file's ending do not belong to the recipe.
    packed = re.fullmatch(r"(?:.*/)?(.+?)(?:\.safetensors)?@\d+(\+.*)?", driver)
    return driver if packed is None else packed[1] + (packed[2] or "")


def seed_of(driver: str) -> int:
    """3 of ``agent_idm@3+safe``; 0 where no seed is named: ``agent_idm`` is ``agent_idm@0``."""
    named = re.search(r"@(\d+)(?:\+|$)", driver)
    return int(named[1]) if named else 0


def by_recipe(episodes: pl.DataFrame) -> dict[tuple[str, str], dict[str, pl.DataFrame]]:
    """The episodes of the matrix by recipe and traffic, in the order in which they first appear."""
    cells: dict[tuple[str, str], dict[str, pl.DataFrame]] = {}
    for (driver, traffic), frame in episodes.group_by("agent", "traffic", maintain_order=True):
        recipe = recipe_of(str(driver))
        trainings = cells.setdefault((recipe, str(traffic)), {})
        trainings[str(driver)] = frame.sort("episode")
        # The same training twice would count as two.
        if len(set(map(seed_of, trainings))) < len(trainings):
            names = ", ".join(trainings)
            raise UserError(
                f"agents: two of one seed are called {recipe} ({names}); leave one out."
            )
    return cells


def column(trainings: Mapping[str, pl.DataFrame], value: str | pl.Expr) -> Array:
    """A column of each training as a table [S, E]."""
    columns = [frame.select(value).to_series() for frame in trainings.values()]
    return np.stack([series.cast(pl.Float64).to_numpy() for series in columns])


def _ended(reasons: Sequence[str]) -> pl.Expr:
    return pl.col("reason").is_in(list(reasons))


def rows(cells: Cells) -> list[Row]:
    """One row per recipe and traffic.

    Returns:
        Per row ``driver, traffic, trainings`` S, ``episodes`` E of each; ``mean_reward``,
        ``interquartile_mean`` (of the trainings' mean rewards) and ``reward_sd`` (over all
        episodes); ``minus_mobil`` and ``probability_above_mobil`` (None for MOBIL, the latter for a
        single training, too); ``normalized_percent``; ``hard_crash``, ``soft_crash`` (episodes with
        one) and ``out_of_road`` of all trainings together; ``hard_crash_share`` (exact interval of
        all episodes, as if they were independent); ``crashes``, ``departures`` and ``failures``
        (both) ``_per_1000_km``;
        ``mean_speed_mps, lane_changes_per_km, soft_crash_behind_per_episode``; ``at_fault_share``
        of the hard crashes (None without any); and ``each``, mean reward, lead over MOBIL and
        failures of every training. A key with ``_ci`` holds the 95 % interval of its namesake over
        trainings and episodes.
    """
    return [_row(recipe, traffic, cells) for recipe, traffic in cells]


def _row(recipe: str, traffic: str, cells: Cells) -> Row:
    trainings = cells[recipe, traffic]
    # Both [S, E]: trainings by episodes.
    rewards = column(trainings, "reward")
    km = column(trainings, pl.col("distance_m") / 1000.0)
    # MOBIL drives on every traffic; it is not compared with itself.
    mobil = column(cells[SCALE_TOP, traffic], "reward")
    is_mobil = recipe == SCALE_TOP
    # What cannot be said stays None and is printed as a dash.
    score = None
    if (SCALE_BOTTOM, traffic) in cells:
        random_legal = column(cells[SCALE_BOTTOM, traffic], "reward")
        score = normalized_over_trainings(rewards, mobil, random_legal)
    lead = None if is_mobil else difference(rewards, mobil)
    probability = None if is_mobil else _probability(rewards, mobil)
    # Counts and plain rates are of the episodes of all trainings.
    together = pl.concat(trainings.values())
    crashes = together.filter(_ended(FAILURES[:1]))
    seconds = float(together["duration_s"].sum())
    changes = int(together["lane_changes"].sum())
    driven = float(km.sum())
    row: Row = {
        "driver": recipe,
        "traffic": traffic,
        "trainings": len(rewards),
        "episodes": rewards.shape[1],
        **entries("mean_reward", over_trainings(rewards)),
        **entries("interquartile_mean", over_trainings(rewards, interquartile_mean)),
        "reward_sd": float(rewards.std(ddof=1)),
        **entries("minus_mobil", lead),
        **entries("probability_above_mobil", probability),
        **entries("normalized_percent", score),
        **_failures(together),
        "soft_crash": int(together["had_soft_crash"].sum()),
        **entries("hard_crash_share", clopper_pearson(crashes.height, together.height)),
    }
    for name, ends in _RATES.items():
        rate = rate_over_trainings(column(trainings, _ended(ends)), km)
        row |= entries(f"{name}_per_1000_km", None if rate is None else rate.scaled(1000.0))
    row["mean_speed_mps"] = 1000.0 * driven / seconds if seconds > 0.0 else None
    row["lane_changes_per_km"] = changes / driven if driven > 0.0 else None
    row["soft_crash_behind_per_episode"] = together["soft_crash_behind"].mean()
    row["at_fault_share"] = crashes["at_fault"].mean()
    # Trainings one by one, so that a reader sees how far they lie apart.
    row["each"] = []
    for (name, frame), reward in zip(trainings.items(), rewards[:, None]):
        lead = None if is_mobil else difference(reward, mobil)
        training = {"driver": name, **entries("mean_reward", over_trainings(reward))}
        training |= {**entries("minus_mobil", lead), **_failures(frame)}
        row["each"].append(training)
    return row


def _failures(episodes: pl.DataFrame) -> dict[str, int]:
    return {end: episodes.filter(_ended([end])).height for end in FAILURES}


def comparisons(cells: Cells, pairs: Sequence[tuple[str, str]]) -> list[Row]:
    """Recipes compared on every traffic that both drove on.

    Returns:
        Per pair and traffic ``driver, over, traffic, lead`` (difference of mean rewards),
        ``probability`` (that a training of the first is above one of the second),
        ``crash_difference_per_1000_episodes``, and ``mcnemar``: for each training of the first that
        has a namesake of the second (same seed, or the only one) the episodes in which one alone
        crashed, and the exact probability.
    """
    compared = []
    traffics = dict.fromkeys(traffic for _, traffic in cells)
    for one, other in pairs:
        for traffic in traffics:
            first = cells.get((one, traffic))
            second = cells.get((other, traffic))
            if first is not None and second is not None:
                names = {"driver": one, "over": other, "traffic": traffic}
                compared.append({**names, **_compared(first, second)})
    return compared


def _compared(first: Mapping[str, pl.DataFrame], second: Mapping[str, pl.DataFrame]) -> Row:
    """The numbers of a row of :func:`comparisons`."""
    rewards = column(first, "reward")
    other_rewards = column(second, "reward")
    crashed, other_crashed = (column(cell, _ended(FAILURES[:1])) for cell in (first, second))
    # Per 1000 episodes, which is easier to read than a share.
    more_crashes = _crash_difference(crashed, other_crashed).scaled(1000.0)
    # Trainings of one seed started from the same random numbers.
    namesakes = dict(zip(map(seed_of, second), other_crashed))
    # A driver without trainings, say MOBIL, is held against every training of the first.
    if len(namesakes) == 1:
        namesakes = dict.fromkeys(map(seed_of, first), other_crashed[0])
    tests = []
    for name, crashes in zip(first, crashed):
        if seed_of(name) in namesakes:
            # On the same episodes only those count in which one of the two crashed.
            test = mcnemar(crashes > 0, namesakes[seed_of(name)] > 0)
            tests.append({"driver": name, **vars(test)})
    return {
        **entries("lead", difference(rewards, other_rewards)),
        **entries("probability", _probability(rewards, other_rewards)),
        **entries("crash_difference_per_1000_episodes", more_crashes),
        "mcnemar": tests,
    }


def _crash_difference(first: Array, second: Array) -> Estimate:
    """Difference of the shares of episodes with a crash.

    Where there is none, resampling would leave no doubt.
    """
    if first.any() or second.any():
        return difference(first, second)
    # Nobody crashed, which is no proof that nobody would: the exact bound of no crash in E
    # episodes.
    most = clopper_pearson(0, first.shape[1]).high or 0.0
    return Estimate(0.0, -most, most)


def _probability(first: Array, second: Array) -> Estimate | None:
    """None where neither has a second training: it says nothing then."""
    return probability_of_improvement(first, second) if len(first) + len(second) > 2 else None


def rows_of(
    rows: Sequence[Row],
    traffics: Sequence[str],
    drivers: Sequence[str],
) -> list[Row]:
    """The rows of ``drivers``, which may say that they have no mask, on ``traffics``."""
    # The default command drives the agents without a mask, under names that say so.
    names = {name for driver in drivers for name in (driver, f"{driver}+none")}
    return [row for row in rows if row["traffic"] in traffics and row["driver"] in names]


# Tables


def _trainings(row: Row) -> str:
    return f"{row['trainings']} x {row['episodes']}"


def matrix_table(rows: Sequence[Row]) -> Table:
    """Every driver on every traffic."""
    columns: Mapping[str, Cell] = {
        "driver": text_of("driver"),
        "traffic": text_of("traffic"),
        "episodes": _trainings,
        "mean reward": number_of("mean_reward", 1),
        "interquartile mean": number_of("interquartile_mean", 1),
        "minus MOBIL": number_of("minus_mobil", 1),
        "P(above MOBIL)": number_of("probability_above_mobil", 2),
        "hard": text_of("hard_crash"),
        "off road": text_of("out_of_road"),
        "both per 1000 km": number_of("failures_per_1000_km", 1),
        "at fault": number_of("at_fault_share", 2),
        "m/s": number_of("mean_speed_mps", 1),
        "changes/km": number_of("lane_changes_per_km", 2),
        "close behind": number_of("soft_crash_behind_per_episode", 2),
    }
    return Table.of("Every driver on every traffic", rows, columns, names=2)


def table_vi(rows: Sequence[Row]) -> Table:
    """Crashes among rule-followers, beside the paper's."""
    columns = {
        "hard": text_of("hard_crash"),
        "soft": text_of("soft_crash"),
        "share of hard [95 %, exact]": number_of("hard_crash_share", 4),
        "each training": _each("hard_crash", 0),
    }
    paper = [
        ["paper", "Traffic_IDM", name, "not stated", *map(str, counts), "", ""]
        for name, counts in PAPER_VI.items()
    ]
    ours = rows_of(rows, ["idm", "idm_mobil"], [*PAPER_VI, "mobil"])
    return _beside("Table VI: crashes on rule-driven traffic", paper, ours, columns)


def table_vii(rows: Sequence[Row]) -> Table:
    """The normalised score on generated traffic, beside the paper's."""
    columns = {
        "% of MOBIL": number_of("normalized_percent", 1),
        "mean reward": number_of("mean_reward", 1),
        "sd": number_of("reward_sd", 1),
        "each training": _each("mean_reward", 1),
    }
    note = (
        "% of MOBIL is 100 (R - R_random) / (R_MOBIL - R_random): 0 for random legal driving, 100 "
        "for MOBIL; the paper does not define its own."
    )
    paper = [
        ["paper", "Traffic_GAN", name, "1000", *(f"{value:.2f}" for value in numbers), ""]
        for name, numbers in PAPER_VII.items()
    ]
    ours = rows_of(rows, ["gan"], [*PAPER_VII, "mobil", "random_legal"])
    title = "Table VII: performance on generated traffic"
    return _beside(title, paper, ours, columns, [note])


def _each(key: str, digits: int) -> Cell:
    """Makes the cell with a number of every training."""
    return lambda row: ", ".join(number(training[key], digits) for training in row["each"])


def _beside(
    title: str,
    paper: list[list[str]],
    ours: list[Row],
    columns: Mapping[str, Cell],
    notes: Sequence[str] = (),
) -> Table:
    """The paper's lines above our rows."""
    names: Mapping[str, Cell] = {
        "source": lambda row: "here",
        "traffic": text_of("traffic"),
        "driver": text_of("driver"),
        "episodes": _trainings,
    }
    here = Table.of(title, ours, {**names, **columns}, 3, notes)
    return replace(here, lines=[*paper, *here.lines])


def comparison_table(rows: Sequence[Row]) -> Table:
    """Pairs of drivers on the same episodes."""

    def tests(row: Row) -> str:
        return "; ".join(
            f"{test['only_first']}/{test['only_second']}, {test['p_value']:.2g}"
            for test in row["mcnemar"]
        )

    columns: Mapping[str, Cell] = {
        "driver": text_of("driver"),
        "over": text_of("over"),
        "traffic": text_of("traffic"),
        "lead in reward": number_of("lead", 1),
        "P(improvement)": number_of("probability", 2),
        "crashes per 1000 episodes, more": number_of("crash_difference_per_1000_episodes", 1),
        "McNemar, each training: crashed alone, p": tests,
    }
    return Table.of("Drivers compared on the same episodes", rows, columns, names=3)


# Files


def write_report(
    folder: Path,
    tables: Mapping[str, Table],
    figures: Mapping[str, Figure],
    intro: Sequence[str],
) -> Path:
    """Write every figure as PNG and SVG, and ``report.html`` with tables and figures; its path."""
    # Everything is within the page, so that it opens without a network.
    parts = [f"<p>{html.escape(line)}</p>" for line in intro]
    for name, figure in figures.items():
        for kind in ("png", "svg"):
            save_figure(figure, folder / f"{name}.{kind}")
        drawing = (folder / f"{name}.svg").read_text(encoding="utf-8")
        # Without the XML declaration, the drawing may stand in a page.
        drawing = drawing[drawing.index("<svg") :]
        parts.append(f"<h2>{name.replace('_', ' ').capitalize()}</h2>{drawing}")
    # Figures first, tables below.
    parts += map(_html, tables.values())
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>ganlane: the tables and figures</title><style>{_CSS}</style>"
        f"<h1>The tables and figures</h1>{''.join(parts)}</html>\n"
    )
    write_bytes(folder / "report.html", page.encode())
    return folder / "report.html"


def _html(table: Table) -> str:
    # The columns with names are headings of their line.
    head = "".join(f"<th>{html.escape(name)}</th>" for name in table.headings)
    lines = [f"<tr>{head}</tr>"]
    # Everything is escaped: names of drivers and traffics come from the user.
    for line in table.lines:
        cells = [html.escape(cell) for cell in line]
        names = "".join(f'<th scope="row">{cell}</th>' for cell in cells[: table.names])
        numbers = "".join(f"<td>{cell}</td>" for cell in cells[table.names :])
        lines.append(f"<tr>{names}{numbers}</tr>")
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in table.notes)
    body = f'<div class="wide"><table>{"".join(lines)}</table></div>'
    return f"<h2>{html.escape(table.title)}</h2>{body}{notes}"


def write_csv(path: Path, content: pl.DataFrame | Table | Sequence[Row]) -> None:
    """Numbers, a table as it is printed, or rows, as CSV, atomically.

    Of rows, an interval becomes two columns (``_low``, ``_high``), and lists are left out.
    """
    if isinstance(content, Table):
        # An empty cell reads as null; a dash would make the column a text.
        shown = [["" if cell == NOTHING else cell for cell in line] for line in content.lines]
        frame = pl.DataFrame(shown, dict.fromkeys(content.headings, pl.String), orient="row")
    elif isinstance(content, pl.DataFrame):
        frame = content
    else:
        frame = pl.DataFrame(list(map(_flat, content)), infer_schema_length=None)
    with atomic_path(path) as part:
        frame.write_csv(part)


def _flat(row: Row) -> Row:
    # CSV has neither pairs nor lists in a cell.
    flat: Row = {}
    for key, value in row.items():
        if key.endswith("_ci"):
            name = key.removesuffix("_ci")
            flat[f"{name}_low"], flat[f"{name}_high"] = value or (None, None)
        elif not isinstance(value, list):
            flat[key] = value
    return flat
