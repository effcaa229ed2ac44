"""Tables beside the paper's, figures, and all of it in one page that needs no network."""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, NullLocator

from ganlane.evaluation.table import NOTHING, Table, number, with_interval
from ganlane.files import write_bytes
from ganlane.reproduce.numbers import Row
from ganlane.view.figures import COLOURS, FAINT, INK, STYLE, add_legend, panel_grid, read_metrics, save_figure

#: The paper's Table VI: hard and soft crashes on Traffic_IDM, of an unstated number of runs.
PAPER_VI = {"agent_idm": (19, 2), "agent_gan": (9, 0)}
#: The paper's Table VII: % of MOBIL, mean reward and its standard deviation on Traffic_GAN, 1000 runs.
PAPER_VII = {"agent_idm": (5.21, -22.33, 100.66), "agent_gan": (114.82, 33.62, 95.19)}
_CSS = (
    "body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#262a30}"
    "table{border-collapse:collapse;font-size:13px;margin:1em 0}td,th{padding:2px 9px;text-align:right}"
    "th{border-bottom:1px solid #6e747c}td.name,th.name{text-align:left}svg{max-width:100%;height:auto}"
    ".wide{overflow-x:auto}"
)


def _plain(row: Row, driver: str) -> bool:
    return row["driver"] in (driver, f"{driver}+none")


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
    drivers = (*PAPER_VI, "mobil")
    ours = [
        row for row in rows if row["traffic"] in ("idm", "idm_mobil") and any(_plain(row, name) for name in drivers)
    ]
    here = Table.of("Table VI: crashes on rule-driven traffic", ours, columns, names=3)
    paper = [
        ["paper", "Traffic_IDM", name, "not stated", *map(str, counts), "", ""] for name, counts in PAPER_VI.items()
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
        "each training": lambda row: ", ".join(number(each["mean_reward"], 1) for each in row["each"]),
    }
    note = (
        "% of MOBIL is 100 (R - R_random) / (R_MOBIL - R_random): 0 for random legal driving, 100 for MOBIL; the "
        "paper does not define its own."
    )
    drivers = (*PAPER_VII, "mobil", "random_legal")
    ours = [row for row in rows if row["traffic"] == "gan" and any(_plain(row, name) for name in drivers)]
    here = Table.of("Table VII: performance on generated traffic", ours, columns, names=3, notes=[note])
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
            f"{each['only_first']}/{each['only_second']}, {each['p_value']:.2g}" for each in row["mcnemar"]
        ),
    }
    return Table.of("Drivers compared on the same episodes", rows, columns, names=3)


#: Ticks of the leads: linear up to 20, logarithmic beyond.
_LEADS = (-300, -100, -20, -10, 0, 10, 20, 100)


@rc_context(STYLE)
def draw_matrix(rows: Sequence[Row]) -> Figure:
    """Lead over MOBIL, one panel per traffic: the interval over trainings and episodes, a dot for each training."""
    drawn = [row for row in rows if row["minus_mobil"] is not None]
    drivers = list(dict.fromkeys(row["driver"] for row in drawn))
    traffics = list(dict.fromkeys(row["traffic"] for row in drawn))
    mobil = {row["traffic"]: row["mean_reward"] for row in rows if row["driver"] == "mobil"}
    bounds = [bound for row in drawn for bound in row["minus_mobil_ci"] or (row["minus_mobil"],)]
    lowest, highest = min(-20.0, *bounds), max(20.0, *bounds)
    figure, grid = panel_grid(len(traffics), 3.4, 1.3 + 0.19 * len(drivers))
    for place, (axes, traffic) in enumerate(zip(grid, traffics)):
        axes.axvline(0.0, color=FAINT, lw=0.9)
        axes.set(title=traffic, xlabel="mean reward minus MOBIL's", ylim=(len(drivers) - 0.5, -0.5))
        axes.set_xscale("symlog", linthresh=20.0)
        axes.set_yticks(range(len(drivers)), drivers if place % 3 == 0 else [])
        axes.set_xticks([x for x in _LEADS if lowest <= x <= highest], minor=False)
        axes.set_xlim(1.15 * lowest, 1.15 * highest)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        for row in drawn:
            if row["traffic"] == traffic:
                line, trained = drivers.index(row["driver"]), len(row["each"]) > 1
                colour = COLOURS[0] if trained else INK
                low, high = row["minus_mobil_ci"] or (row["minus_mobil"],) * 2
                axes.plot([low, high], [line, line], color=colour, lw=2.2, solid_capstyle="butt")
                axes.plot(row["minus_mobil"], line, "o", color=colour)
                each = [training["mean_reward"] - mobil[traffic] for training in row["each"]]
                if trained:
                    axes.plot(each, [line] * len(each), "|", color=COLOURS[1], ms=6, mew=1)
    one = Line2D([], [], color=COLOURS[1], marker="|", ls="", ms=6, label="one training")
    names = {"a recipe: mean, 95 % over trainings and episodes": COLOURS[0], "a single driver": INK}
    add_legend(figure, names, [one])
    return figure


@dataclass(frozen=True)
class Transfer:
    """Learning curves over the decisions: both phases, one line per run, and what the agent earned at the switch."""

    runs: Mapping[str, pl.DataFrame]
    switch: float
    at_switch: Sequence[float]


def read_transfers(folders: Sequence[str], rows: Sequence[Row]) -> Transfer | None:
    """The evaluations of training runs with two phases; None without any run.

    Raises:
        UserError: a folder without evaluations of both phases.
    """
    runs: dict[str, pl.DataFrame] = {}
    switch = 0.0
    for folder in map(Path, folders):
        first, second = (
            read_metrics(part / "evaluation.csv").select("decisions", "mean_reward")
            for part in (folder / "pretrain", folder)
        )
        switch = max(switch, float(first["decisions"][-1]))
        later = second.with_columns(pl.col("decisions") + first["decisions"][-1])
        phases = [first.with_columns(phase=pl.lit("first")), later.with_columns(phase=pl.lit("second"))]
        runs[folder.name] = pl.concat(phases, how="vertical_relaxed")
    at_switch = [
        each["mean_reward"]
        for row in rows
        if row["traffic"] == "gan" and _plain(row, "agent_idm")
        for each in row["each"]
    ]
    return Transfer(runs, switch, at_switch) if runs else None


@rc_context(STYLE)
def draw_transfer(transfer: Transfer) -> Figure:
    """Figure 4: every run, their median, and the range between them; the switch of the traffic is marked."""
    figure = Figure(figsize=(7.0, 3.4))
    axes = figure.subplots()
    axes.set(title="evaluations during training", xlabel="decisions", ylabel="mean reward")
    axes.xaxis.set_major_formatter(EngFormatter())
    for phase, colour in zip(("first", "second"), COLOURS):
        lines = [frame.filter(pl.col("phase") == phase) for frame in transfer.runs.values()]
        x = lines[0]["decisions"].cast(pl.Float64).to_numpy()
        y = np.stack([np.interp(x, line["decisions"].to_numpy(), line["mean_reward"].to_numpy()) for line in lines])
        axes.fill_between(x, y.min(axis=0), y.max(axis=0), color=colour, alpha=0.2, lw=0)
        axes.plot(x, np.median(y, axis=0), color=colour)
        for line in lines if len(lines) > 1 else []:
            axes.plot(line["decisions"], line["mean_reward"], color=colour, lw=0.5, alpha=0.6)
    axes.axvline(transfer.switch, color=FAINT, ls=":")
    if transfer.at_switch:
        axes.plot([transfer.switch] * len(transfer.at_switch), transfer.at_switch, "x", color=COLOURS[1])
    add_legend(figure, {"on idm_mobil": COLOURS[0], "on gan (x: before any training there)": COLOURS[1]})
    return figure


def write_report(
    folder: Path, tables: Mapping[str, Table], figures: Mapping[str, Figure], intro: Sequence[str]
) -> Path:
    """Write every figure as PNG and SVG, and ``report.html`` with tables and figures inline; its path."""
    parts = [f"<p>{html.escape(line)}</p>" for line in intro]
    for name, figure in figures.items():
        for kind in ("png", "svg"):
            save_figure(figure, folder / f"{name}.{kind}")
        drawing = (folder / f"{name}.svg").read_text(encoding="utf-8")
        parts.append(f"<h2>{name.replace('_', ' ').capitalize()}</h2>{drawing[drawing.index('<svg') :]}")
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
        return "<tr>" + "".join(f"<{tag} {kind}>{html.escape(x)}</{tag}>" for kind, x in zip(kinds, cells)) + "</tr>"

    body = "".join(line(cells, "td") for cells in table.lines)
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in table.notes)
    table_itself = f"<table>{line(table.headings, 'th')}{body}</table>"
    return f'<h2>{html.escape(table.title)}</h2><div class="wide">{table_itself}</div>{notes}'


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]] | Table) -> None:
    """A table as it is printed, or rows, as CSV: an interval as two columns (``_low``, ``_high``), no lists."""
    if isinstance(rows, Table):
        shown = [["" if cell == NOTHING else cell for cell in line] for line in rows.lines]
        rows = [dict(zip(rows.headings, line)) for line in shown]
    flat = []
    for row in rows:
        cells: dict[str, Any] = {}
        for key, value in row.items():
            if key.endswith("_ci"):
                low, high = value or (None, None)
                cells |= {f"{key.removesuffix('_ci')}_low": low, f"{key.removesuffix('_ci')}_high": high}
            elif not isinstance(value, list):
                cells[key] = value
        flat.append(cells)
    buffer = io.BytesIO()
    pl.DataFrame(flat, infer_schema_length=None).write_csv(buffer)
    write_bytes(path, buffer.getvalue())
