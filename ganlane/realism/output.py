"""Writes a card: tables on stdout, a section of a document, figures, and the file that ships."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from ganlane.config.folders import OVERRIDES
from ganlane.config.realism import RealismConfig
from ganlane.errors import UserError
from ganlane.evaluation import code_version, machine
from ganlane.files import split_at_markers, write_between_markers, write_bytes
from ganlane.realism import references
from ganlane.realism.card import Card, floors_of
from ganlane.realism.figures import card_figures
from ganlane.realism.make_card import print_progress
from ganlane.realism.starts import Starts
from ganlane.view.figures import save_figure

_NOTHING = "-"
#: The check of a guard, and its answer where there is none.
_GUARD, _WITHOUT_GUARD = "guard_under_5_percent", "no guard"


def check_targets(config: RealismConfig, path: Path | None) -> None:
    """Raise :class:`UserError` before anything is driven if the results could not be written."""
    if config.publish and path is None:
        raise UserError("publish=true: the file that ships is made from recordings; give data.path=FILE.")
    if config.report is not None:
        split_at_markers(Path(config.report), *markers(config.card()))
    if config.figures is not None and not Path(config.figures).is_dir():
        raise UserError(f"figures={config.figures}: no such folder; make it, or name another.")


def draw(card: Card, to: Path) -> list[Path]:
    """The figures of a card, into the folder ``to``."""
    figures = card_figures(card.starts, card.runs, card.quantities, card.traffic)
    return [save_figure(figure, to / f"{name}.png") for name, figure in figures.items()]


def show(
    config: RealismConfig, folder: Path, tables: list[str], numbers: Mapping[str, Any], drawn: Sequence[Path]
) -> None:
    """Print the tables; write tables and figures into a document if asked for."""
    print(*tables, sep="\n\n")
    if config.report is not None:
        text = document_text(tables, numbers, command_line(folder), date.today().isoformat())
        write_between_markers(Path(config.report), *markers(config.card()), f"\n{text}\n")
    for path in drawn if config.figures is not None else []:
        write_bytes(Path(str(config.figures)) / f"realism_{path.name}", path.read_bytes())


def command_line(folder: Path) -> str:
    """The command line of the run in ``folder``, without ``report`` and ``figures``."""
    from omegaconf import OmegaConf

    asked = [str(override) for override in OmegaConf.load(folder / OVERRIDES)]
    kept = [override for override in asked if not override.startswith(("report=", "figures=", "hydra."))]
    return shlex.join(["python", "-m", "ganlane.realism", *kept])


def publish(starts: Starts) -> None:
    """Write the file that ships, with the distances of the reference drivers measured in this run."""
    source = Path(starts.reference.source).name
    floors = floors_of(starts.driven, starts.recorded)
    replace(starts.reference, floors=floors, source=source).save(references.SHIPPED_REFERENCE)
    print_progress(f"wrote {references.SHIPPED_REFERENCE}")


def markers(card: str) -> tuple[str, str]:
    """The lines that enclose a card in a document; its name holds traffic and starts."""
    return f"<!-- begin realism {card} -->", f"<!-- end realism {card} -->"


def card_text(numbers: Mapping[str, Any], long_runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """The card's tables, as they are printed.

    Args:
        numbers: what ``results.json`` holds.
        long_runs: by traffic; those that drove none are left out.
    """
    traffic = numbers["traffic"]
    tables = [quantities_table(numbers["quantities"], traffic)]
    if numbers["quantities_held_out"] is not None:
        tables.append(f"held-out scenes alone\n{quantities_table(numbers['quantities_held_out'], traffic)}")
    tables.append(starts_table(numbers["driving"]))
    tables += [f"I-80, {name}\n{quantities_table(rows, traffic)}" for name, rows in numbers["i80"].items()]
    tables += [long_table(runs, name) for name, runs in long_runs.items() if runs]
    return [*tables, checks_text(numbers["checks"])]


def document_text(tables: Sequence[str], numbers: Mapping[str, Any], command: str, written: str) -> str:
    """A card's section of a document: command, machine, starts, tables."""
    here, code = machine(), code_version()
    revision = f" ({code['revision'][:12]}{', modified' if code['modified'] else ''})" if code["revision"] else ""
    excess = ", ".join(f"{name} {value:g}" for name, value in numbers["desired_above_mps"].items())
    paragraphs = [
        f"Written by the command on {written}:\n\n    {command}",
        f"Taken with Python {here['python']}, torch {here['torch']}, ganlane {code['version']}{revision}, from "
        f"{numbers['starts']} starts: {', '.join(numbers['scenes']) or 'none recorded'}. Desired speeds above the "
        f"speed at entry, mean, m/s: {excess or 'not fitted'}.",
    ]
    return "\n\n".join([*paragraphs, *(f"```text\n{table}\n```" for table in tables)])


def quantities_table(quantities: Mapping[str, Any], traffic: str) -> str:
    """Distances, one quantity per line: the traffic, the scale, and each rival with the difference to it."""
    others = list(next(iter(quantities.values()))["against"])
    heading = ["distance to recorded", f"{short_name(traffic)} [95 %]", "ceiling", "constant v", "random"]
    for other in others:
        heading += [short_name(other), f"minus {short_name(other)} [95 %]", ""]
    lines = [heading]
    for name, row in quantities.items():
        scale = (_number(row[key]) for key in ("ceiling", "constant_velocity", "floor"))
        line = [f"{name}, {row['unit']}", _with_interval(row, "distance"), *scale]
        for other in others:
            rival = row["against"][other]
            line += [_number(rival["distance"]), _with_interval(rival, "difference"), rival["verdict"]]
        lines.append(line)
    return _aligned(lines)


def starts_table(driving: Mapping[str, Any]) -> str:
    """Lane changes and accelerations, one traffic per line, the recordings among them."""
    lines = [["from the same starts", "changes per vehicle-km [95 %]", "vehicle-km", "acceleration 5 %, 95 %"]]
    for name, row in driving.items():
        low, high = (row["quantiles"]["acceleration"][level] for level in ("0.05", "0.95"))
        rate = _with_interval(row, "per_vehicle_km", 2)
        lines.append(
            [short_name(name), rate, _number(row["vehicle_km"], 1), f"{_number(low, 2)}, {_number(high, 2)}"]
        )
    return _aligned(lines)


def long_table(runs: Sequence[Mapping[str, Any]], traffic: str) -> str:
    """The long runs of a traffic, one column each."""
    rows: list[list[str]] = [[f"{short_name(traffic)}, long runs", *(f"{run['vehicles']} vehicles" for run in runs)]]
    plain = ("off_road", "standstills_in_free_flow")
    rows.append(["vehicle-km", *(_number(run["vehicle_km"], 0) for run in runs)])
    rows.append(["changes per vehicle-km", *(_with_interval(run, "lane_changes_per_vehicle_km", 2) for run in runs)])
    rows.append(
        ["overlaps per 1000 vehicle-km", *(_with_interval(run, "overlaps_per_1000_vehicle_km", 2) for run in runs)]
    )
    rows += [[name.replace("_", " "), *(str(run[name]) for run in runs)] for name in plain]
    for time in runs[0]["speeds"]:
        at = [run["speeds"][time] for run in runs]
        cells = [f"{_number(each['mean_speed_mps'], 1)}, {_number(each['spread_mps'], 2)}" for each in at]
        rows.append([f"mean speed, spread after {time}, m/s", *cells])
    for level in runs[0]["acceleration_quantiles"]:
        cells = [_number(run["acceleration_quantiles"][level], 2) for run in runs]
        rows.append([f"acceleration, {100 * float(level):g} % quantile", *cells])
    shares = ["none" if run["guard_share"] is None else f"{100 * run['guard_share']:.1f} %" for run in runs]
    rows.append(["the guard's share", *shares])
    return _aligned(rows)


def checks_text(checks: Mapping[str, Any]) -> str:
    """The card's checks, a line each."""
    words = {True: "yes", False: "no", None: "not told"}
    near = "acceleration_quantiles_within_30_percent"
    lines = [f"{near.replace('_', ' ')}: {words[checks[near]]}"]
    for other, verdicts in checks["compared_with"].items():
        lines.append(
            f"than {short_name(other)}: " + ", ".join(f"{name} {verdict}" for name, verdict in verdicts.items())
        )
    for run in checks["long_runs"]:
        results = ", ".join(
            f"{name.replace('_', ' ')}: {_WITHOUT_GUARD if name == _GUARD and value is None else words[value]}"
            for name, value in run.items()
            if name != "vehicles"
        )
        lines.append(f"{run['vehicles']} vehicles: {results}")
    return "\n".join(lines)


def short_name(traffic: str) -> str:
    """A traffic's name without the path that it is imported from."""
    return traffic.rpartition(".")[2]


def _number(value: float | None, digits: int = 3) -> str:
    return _NOTHING if value is None else f"{value:.{digits}f}"


def _with_interval(row: Mapping[str, Any], name: str, digits: int = 3) -> str:
    interval = row.get(f"{name}_ci")
    text = _number(row.get(name), digits)
    return text if not interval else f"{text} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"


def _aligned(lines: Sequence[Sequence[str]]) -> str:
    """A text table: first column left-aligned, the others right-aligned, with a line under the header."""
    widths = [max(map(len, column)) for column in zip(*lines)]

    def aligned(line: Sequence[str]) -> str:
        first, *rest = (cell.rjust(width) for cell, width in zip(line, widths))
        return "  ".join([first.strip().ljust(widths[0]), *rest]).rstrip()

    return "\n".join([aligned(lines[0]), "  ".join("-" * width for width in widths), *map(aligned, lines[1:])])
