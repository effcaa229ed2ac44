"""The runs of a hyperparameter search in one table: their differences, and their scores on the
selection stream.

    python -m benchmarks.search outputs/train_sweeps/SWEEP
    python -m benchmarks.search outputs/train_sweeps/* --report docs/search.md --csv docs/search.csv

Reads config.yaml, evaluation.csv and metrics.csv of every run below the folders; runs that are not
finished are listed with what they have. ``--report`` puts the table between the two marker lines of
a document.
"""

from __future__ import annotations

import argparse
import csv
import io
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from benchmarks.script import ReportSection, add_report, make_parser, run_script
from ganlane.errors import UserError, as_typed
from ganlane.evaluation.table import Table
from ganlane.files import write_bytes
from ganlane.training.checkpoint import flat
from ganlane.training.logs import read_rows

BEGIN, END = "<!-- search: begin -->", "<!-- search: end -->"
#: Options that change nothing in what is learned.
ASIDE = ("resume", "threads", "logger.", "checkpoint_")
SCORE = "mean_reward"


@dataclass(frozen=True)
class SearchRun:
    """One run folder.

    Its options by dotted name, rows of its evaluations and of its metrics as they stand there.
    """

    name: str
    options: dict[str, Any]
    evaluations: list[dict[str, str]]
    metrics: list[dict[str, str]]

    @property
    def best(self) -> dict[str, str]:
        """The evaluation with the highest score, the first of several; empty without any."""
        return max(self.evaluations, key=lambda row: float(row[SCORE]), default={})


def read_runs(folders: Iterable[Path]) -> list[SearchRun]:
    """Every run that has begun to train, anywhere below ``folders``.

    Raises:
        UserError: a folder without any.
    """
    runs = []
    for folder in folders:
        found = sorted(
            (
                path.parent
                for path in folder.rglob("config.yaml")
                if (path.parent / "metrics.csv").is_file()
            ),
            key=_in_order,
        )
        if not found:
            raise UserError(
                f"{folder}: no run there with config.yaml and metrics.csv; give the folder of a sweep."
            )
        runs += [read_run(path, folder) for path in found]
    return runs


def read_run(path: Path, sweep: Path) -> SearchRun:
    """The run in ``path``, below ``sweep``."""
    config = OmegaConf.to_container(OmegaConf.load(path / "config.yaml"))
    options = {name: value for name, value in flat(config).items() if not name.startswith(ASIDE)}  # type: ignore[arg-type]
    evaluations = [row for row in read_rows(path / "evaluation.csv") if row.get(SCORE)]
    name = f"{sweep.name}/{path.relative_to(sweep)}" if path != sweep else sweep.name
    return SearchRun(name, options, evaluations, read_rows(path / "metrics.csv"))


def _in_order(path: Path) -> tuple[int, str]:
    """Hydra numbers the runs of a sweep: 2 before 10."""
    return (int(path.name), "") if path.name.isdigit() else (sys.maxsize, str(path))


def differing(runs: Sequence[SearchRun]) -> list[str]:
    """Names of the options that are not the same in all runs, as the configs list them."""
    names = dict.fromkeys(name for run in runs for name in run.options)
    return [
        name
        for name in names
        if any(run.options.get(name) != runs[0].options.get(name) for run in runs)
    ]


def table(runs: Sequence[SearchRun]) -> list[dict[str, str]]:
    """One row per run, the best score first.

    Cells as they are shown, empty where there is nothing to show.
    """
    options = differing(runs)
    ordered = sorted(runs, key=lambda run: float(run.best.get(SCORE, "-inf")), reverse=True)
    return [_row(run, options) for run in ordered]


def _row(run: SearchRun, options: Sequence[str]) -> dict[str, str]:
    best, last = run.best, run.evaluations[-1] if run.evaluations else {}
    end = run.metrics[-1] if run.metrics else {}
    seconds = float(end.get("wall_s") or 0.0)
    return {
        "run": run.name,
        **{name: as_typed(run.options.get(name)) for name in options},
        "decisions": _count(end),
        "best": _number(best, SCORE),
        "best s.e.": _number(best, "standard_error"),
        "best at": _count(best),
        "last": _number(last, SCORE),
        "last s.e.": _number(last, "standard_error"),
        "crash rate": _number(best, "crash_rate", "{:.3f}"),
        "changes/km": _number(best, "lane_changes_per_km", "{:.2f}"),
        "decisions/s": f"{float(end['decisions']) / seconds:.0f}" if seconds > 0.0 else "",
    }


def _count(row: Mapping[str, str]) -> str:
    return row.get("decisions", "")


def _number(row: Mapping[str, str], name: str, form: str = "{:.1f}") -> str:
    return form.format(float(row[name])) if row.get(name) else ""


def compact(rows: Sequence[Mapping[str, str]], options: Sequence[str]) -> list[dict[str, str]]:
    """The same rows with the options in one cell.

    Only those in which a run differs from what most of them have.
    """
    usual = {name: Counter(row[name] for row in rows).most_common(1)[0][0] for name in options}
    short = []
    for row in rows:
        own = " ".join(f"{name}={row[name]}" for name in options if row[name] != usual[name])
        rest = {name: value for name, value in row.items() if name not in {"run", *options}}
        short.append({"what differs": f"`{own}`" if own else "(the middle)", **rest})
    return short


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """The rows as a table."""
    lines = [list(row.values()) for row in rows]
    return Table("", list(rows[0]), lines, names=len(rows[0])).markdown(heading=False)


def as_csv(rows: Sequence[Mapping[str, str]]) -> str:
    """The rows as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="of sweeps, or of single runs")
    parser.add_argument("--csv", type=Path, help="where to write the table as CSV")
    add_report(parser, BEGIN, END)
    return parser.parse_args(arguments)


def report(options: argparse.Namespace) -> str:
    """The table, in the document and as CSV too where they are named."""
    section = ReportSection(options.report, BEGIN, END)
    runs = read_runs(options.folders)
    rows = table(runs)
    text = markdown(compact(rows, differing(runs)))
    section.write(text)
    if options.csv:
        write_bytes(options.csv, as_csv(rows).encode())
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and write it where asked; the exit status."""
    return run_script(report, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
