"""The report.

A row for each recipe on each traffic, drivers compared, tables beside the paper's, and a page.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable, Mapping, Sequence
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
from ganlane.evaluation.table import NOTHING, Table, number, with_interval
from ganlane.files import write_bytes
from ganlane.view.figures import save_figure

Row = dict[str, Any]
#: Recipe and traffic to the episodes of each training, by driver's name.
Cells = Mapping[tuple[str, str], Mapping[str, pl.DataFrame]]
#: Rates per 1000 km by name: the ends that they count.
_RATES = {"crashes": FAILURES[:1], "departures": FAILURES[1:], "failures": FAILURES}
#: The paper's Table VI: hard and soft crashes on Traffic_IDM, of an unstated number of runs.
PAPER_VI = {"agent_idm": (19, 2), "agent_gan": (9, 0)}
#: The paper's Table VII: % of MOBIL, mean reward and its standard deviation on Traffic_GAN, 1000
#: runs.
PAPER_VII = {"agent_idm": (5.21, -22.33, 100.66), "agent_gan": (114.82, 33.62, 95.19)}
_CSS = (
    "body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#262a30}"
    "table{border-collapse:collapse;font-size:13px;margin:1em 0}td,th{padding:2px 9px;text-align:right}"
    "th{border-bottom:1px solid #6e747c}td.name,th.name{text-align:left}svg{max-width:100%;height:auto}"
    ".wide{overflow-x:auto}"
)


def recipe_of(driver: str) -> str:
    """``agent_idm+safe`` of ``agent_idm@3+safe`` and of ``FOLDER/agent_idm.safetensors@3+safe``."""
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
        there = cells.setdefault((recipe, str(traffic)), {})
        there[str(driver)] = frame.sort("episode")
        if len({seed_of(name) for name in there}) < len(there):
            raise UserError(
                f"agents: two of one seed are called {recipe} ({', '.join(there)}); leave one out."
            )
    return cells


def column(trainings: Mapping[str, pl.DataFrame], value: str | pl.Expr) -> Array:
    """A column of each training as a table [S, E]."""
    return np.stack(
        [
            frame.select(value).to_series().cast(pl.Float64).to_numpy()
            for frame in trainings.values()
        ]
    )


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
    return [
        _row(recipe, traffic, trainings, cells) for (recipe, traffic), trainings in cells.items()
    ]


def _row(recipe: str, traffic: str, trainings: Mapping[str, pl.DataFrame], cells: Cells) -> Row:
    rewards, km = column(trainings, "reward"), column(trainings, pl.col("distance_m") / 1000.0)
    mobil, random_legal = (cells.get((name, traffic)) for name in (SCALE_TOP, SCALE_BOTTOM))
    above = None if mobil is None or recipe == SCALE_TOP else column(mobil, "reward")
    together = pl.concat(trainings.values())
    crashes = together.filter(_ended(FAILURES[:1]))
    seconds, driven = float(together["duration_s"].sum()), float(km.sum())
    score = None
    if mobil is not None and random_legal is not None:
        score = normalized_over_trainings(
            rewards, column(mobil, "reward"), column(random_legal, "reward")
        )
    row: Row = {
        "driver": recipe,
        "traffic": traffic,
        "trainings": len(rewards),
        "episodes": rewards.shape[1],
    }
    row |= entries("mean_reward", over_trainings(rewards))
    row |= entries("interquartile_mean", over_trainings(rewards, interquartile_mean))
    row["reward_sd"] = float(rewards.std(ddof=1))
    row |= entries("minus_mobil", None if above is None else difference(rewards, above))
    row |= entries(
        "probability_above_mobil", None if above is None else _probability(rewards, above)
    )
    row |= entries("normalized_percent", score)
    row |= {end: together.filter(_ended([end])).height for end in FAILURES}
    row["soft_crash"] = int(together["had_soft_crash"].sum())
    row |= entries("hard_crash_share", clopper_pearson(crashes.height, together.height))
    for name, ends in _RATES.items():
        rate = rate_over_trainings(column(trainings, _ended(ends)), km)
        row |= entries(f"{name}_per_1000_km", None if rate is None else rate.scaled(1000.0))
    row["mean_speed_mps"] = 1000.0 * driven / seconds if seconds > 0.0 else None
    row["lane_changes_per_km"] = (
        int(together["lane_changes"].sum()) / driven if driven > 0.0 else None
    )
    row["soft_crash_behind_per_episode"] = together["soft_crash_behind"].mean()
    row["at_fault_share"] = crashes["at_fault"].mean() if "at_fault" in crashes.columns else None
    row["each"] = []
    for (name, frame), own in zip(trainings.items(), rewards[:, None]):
        counts = {end: frame.filter(_ended([end])).height for end in FAILURES}
        lead = entries("minus_mobil", None if above is None else difference(own, above))
        row["each"].append(
            {"driver": name, **entries("mean_reward", over_trainings(own)), **lead, **counts}
        )
    return row


def comparisons(cells: Cells, pairs: Sequence[tuple[str, str]]) -> list[Row]:
    """Recipes compared on every traffic that both drove on.

    Returns:
        Per pair and traffic ``driver, over, traffic, lead`` (difference of mean rewards),
        ``probability`` (that a training of the first is above one of the second),
        ``crash_difference_per_1000_episodes``, and ``mcnemar``: for each training of the first that
        has a namesake of the second (same seed, or the only one) the episodes in which one alone
        crashed, and the exact probability.
    """
    found = []
    traffics = dict.fromkeys(traffic for _, traffic in cells)
    for one, other in pairs:
        for traffic in traffics:
            first, second = cells.get((one, traffic)), cells.get((other, traffic))
            if first is None or second is None:
                continue
            a, b = column(first, "reward"), column(second, "reward")
            hit, struck = (column(each, _ended(FAILURES[:1])) for each in (first, second))
            row: Row = {"driver": one, "over": other, "traffic": traffic}
            row |= entries("lead", difference(a, b)) | entries("probability", _probability(a, b))
            row |= entries(
                "crash_difference_per_1000_episodes", _crash_difference(hit, struck).scaled(1000.0)
            )
            theirs = {seed_of(name): crashed > 0 for name, crashed in zip(second, struck)}
            if len(theirs) == 1:
                theirs = dict.fromkeys(map(seed_of, first), struck[0] > 0)
            row["mcnemar"] = [
                {"driver": name, **vars(mcnemar(crashed > 0, theirs[seed_of(name)]))}
                for name, crashed in zip(first, hit)
                if seed_of(name) in theirs
            ]
            found.append(row)
    return found


def _crash_difference(first: Array, second: Array) -> Estimate:
    """Difference of the shares of episodes with a crash.

    Where there is none, resampling would leave no doubt.
    """
    if first.any() or second.any():
        return difference(first, second)
    most = clopper_pearson(0, first.shape[1]).high or 0.0
    return Estimate(0.0, -most, most)


def _probability(first: Array, second: Array) -> Estimate | None:
    """None where neither has a second training: it says nothing then."""
    return probability_of_improvement(first, second) if len(first) + len(second) > 2 else None


def rows_of(rows: Sequence[Row], traffics: Sequence[str], drivers: Sequence[str]) -> list[Row]:
    """The rows of ``drivers``, which may say that they have no mask, on ``traffics``."""
    names = {name for driver in drivers for name in (driver, f"{driver}+none")}
    return [row for row in rows if row["traffic"] in traffics and row["driver"] in names]


def _cell(key: str, digits: int) -> Callable[[Row], str]:
    return lambda row: with_interval(row, key, digits)


_MATRIX: Mapping[str, Callable[[Row], str]] = {
    "driver": lambda row: str(row["driver"]),
    "traffic": lambda row: str(row["traffic"]),
    "episodes": lambda row: f"{row['trainings']} x {row['episodes']}",
    "mean reward": _cell("mean_reward", 1),
    "interquartile mean": _cell("interquartile_mean", 1),
    "minus MOBIL": _cell("minus_mobil", 1),
    "P(above MOBIL)": _cell("probability_above_mobil", 2),
    "hard": lambda row: str(row["hard_crash"]),
    "off road": lambda row: str(row["out_of_road"]),
    "both per 1000 km": _cell("failures_per_1000_km", 1),
    "at fault": lambda row: number(row["at_fault_share"], 2),
    "m/s": lambda row: number(row["mean_speed_mps"], 1),
    "changes/km": lambda row: number(row["lane_changes_per_km"], 2),
    "close behind": lambda row: number(row["soft_crash_behind_per_episode"], 2),
}


def table_vi(rows: Sequence[Row]) -> Table:
    """Crashes among rule-followers, beside the paper's."""
    columns: Mapping[str, Callable[[Row], str]] = {
        "source": lambda row: "here",
        **{name: _MATRIX[name] for name in ("traffic", "driver", "episodes", "hard")},
        "soft": lambda row: str(row["soft_crash"]),
        "share of hard [95 %, exact]": _cell("hard_crash_share", 4),
        "each training": lambda row: ", ".join(str(each["hard_crash"]) for each in row["each"]),
    }
    ours = rows_of(rows, ["idm", "idm_mobil"], [*PAPER_VI, "mobil"])
    here = Table.of("Table VI: crashes on rule-driven traffic", ours, columns, names=3)
    paper = [
        ["paper", "Traffic_IDM", name, "not stated", *map(str, counts), "", ""]
        for name, counts in PAPER_VI.items()
    ]
    return replace(here, lines=[*paper, *here.lines])


def table_vii(rows: Sequence[Row]) -> Table:
    """The normalised score on generated traffic, beside the paper's."""
    columns: Mapping[str, Callable[[Row], str]] = {
        "source": lambda row: "here",
        **{name: _MATRIX[name] for name in ("traffic", "driver", "episodes")},
        "% of MOBIL": _cell("normalized_percent", 1),
        "mean reward": _MATRIX["mean reward"],
        "sd": lambda row: number(row["reward_sd"], 1),
        "each training": lambda row: ", ".join(
            number(each["mean_reward"], 1) for each in row["each"]
        ),
    }
    note = (
        "% of MOBIL is 100 (R - R_random) / (R_MOBIL - R_random): 0 for random legal driving, 100 for MOBIL; the "
        "paper does not define its own."
    )
    ours = rows_of(rows, ["gan"], [*PAPER_VII, "mobil", "random_legal"])
    here = Table.of(
        "Table VII: performance on generated traffic", ours, columns, names=3, notes=[note]
    )
    paper = [
        ["paper", "Traffic_GAN", name, "1000", *(f"{value:.2f}" for value in numbers), ""]
        for name, numbers in PAPER_VII.items()
    ]
    return replace(here, lines=[*paper, *here.lines])


def matrix_table(rows: Sequence[Row]) -> Table:
    """Every driver on every traffic."""
    return Table.of("Every driver on every traffic", rows, _MATRIX, names=2)


def comparison_table(rows: Sequence[Row]) -> Table:
    """Pairs of drivers on the same episodes."""
    columns: Mapping[str, Callable[[Row], str]] = {
        "driver": _MATRIX["driver"],
        "over": lambda row: str(row["over"]),
        "traffic": _MATRIX["traffic"],
        "lead in reward": _cell("lead", 1),
        "P(improvement)": _cell("probability", 2),
        "crashes per 1000 episodes, more": _cell("crash_difference_per_1000_episodes", 1),
        "McNemar, each training: crashed alone, p": lambda row: "; ".join(
            f"{each['only_first']}/{each['only_second']}, {each['p_value']:.2g}"
            for each in row["mcnemar"]
        ),
    }
    return Table.of("Drivers compared on the same episodes", rows, columns, names=3)


def write_report(
    folder: Path, tables: Mapping[str, Table], figures: Mapping[str, Figure], intro: Sequence[str]
) -> Path:
    """Write every figure as PNG and SVG, and ``report.html`` with tables and figures inline.

    Its path.
    """
    parts = [f"<p>{html.escape(line)}</p>" for line in intro]
    for name, figure in figures.items():
        for kind in ("png", "svg"):
            save_figure(figure, folder / f"{name}.{kind}")
        drawing = (folder / f"{name}.svg").read_text(encoding="utf-8")
        parts.append(
            f"<h2>{name.replace('_', ' ').capitalize()}</h2>{drawing[drawing.index('<svg') :]}"
        )
    parts += map(_html, tables.values())
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>ganlane: the tables and figures</title>'
        f"<style>{_CSS}</style><h1>The tables and figures</h1>{''.join(parts)}</html>\n"
    )
    write_bytes(folder / "report.html", page.encode())
    return folder / "report.html"


def _html(table: Table) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        kinds = ['class="name"' if place < table.names else "" for place in range(len(cells))]
        return (
            "<tr>"
            + "".join(f"<{tag} {kind}>{html.escape(x)}</{tag}>" for kind, x in zip(kinds, cells))
            + "</tr>"
        )

    body = "".join(line(cells, "td") for cells in table.lines)
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in table.notes)
    table_itself = f"<table>{line(table.headings, 'th')}{body}</table>"
    return f'<h2>{html.escape(table.title)}</h2><div class="wide">{table_itself}</div>{notes}'


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]] | Table) -> None:
    """A table as it is printed, or rows, as CSV.

    An interval as two columns (``_low``, ``_high``), no lists.
    """
    if isinstance(rows, Table):
        shown = [["" if cell == NOTHING else cell for cell in line] for line in rows.lines]
        rows = [dict(zip(rows.headings, line)) for line in shown]
    flat = []
    for row in rows:
        cells: dict[str, Any] = {}
        for key, value in row.items():
            if key.endswith("_ci"):
                low, high = value or (None, None)
                cells |= {
                    f"{key.removesuffix('_ci')}_low": low,
                    f"{key.removesuffix('_ci')}_high": high,
                }
            elif not isinstance(value, list):
                cells[key] = value
        flat.append(cells)
    buffer = io.BytesIO()
    pl.DataFrame(flat, infer_schema_length=None).write_csv(buffer)
    write_bytes(path, buffer.getvalue())
