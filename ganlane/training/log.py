"""Where the figures of a run go: CSV files and the progress always, further logs if given."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Protocol

from tqdm import tqdm

from ganlane.files import atomic_path
from ganlane.training.config import TrainingConfig
from ganlane.training.progress import Progress

#: Columns of ``metrics.csv``; an action's share follows for each action.
COLUMNS = (
    "decisions",
    "updates",
    "wall_s",
    "decisions_per_s",
    "episodes",
    "mean_return",
    "mean_discounted_return",
    "mean_return_to_go",
    "mean_value",
    "goal_rate",
    "crash_rate",
    "out_of_road_rate",
    "timeout_rate",
    "lane_changes_per_km",
    "loss",
    "mean_q",
    "clamped_fraction",
    "priority",
    "gradient_norm",
    "sigma",
    "epsilon",
)


class Log(Protocol):
    """Takes rows of figures, one per logging interval."""

    def write(self, row: Mapping[str, float]) -> None:
        """Keep one row; it holds ``decisions``."""

    def close(self) -> None:
        """Finish."""


class CsvLog:
    """A CSV file with fixed columns, one line per row, complete after every row.

    Args:
        path: the file; if it exists, its whole rows up to ``decisions`` are kept: a resumed run goes on where the
            checkpoint was made, not where the interrupted run had got to.
        columns: in this order; a row's other entries are dropped, missing ones left empty.
        decisions: where the run starts.
    """

    def __init__(self, path: str | Path, columns: Sequence[str], decisions: int = 0) -> None:
        self.path, self.columns = Path(path), list(columns)
        rows = [row for row in read_rows(self.path) if float(row["decisions"]) <= decisions]
        with atomic_path(self.path) as part, part.open("w", newline="") as file:
            self._writer(file).writeheader()
            self._writer(file).writerows(rows)
        self._file = self.path.open("a", newline="")

    def _writer(self, file: object) -> csv.DictWriter:
        return csv.DictWriter(file, self.columns, extrasaction="ignore", lineterminator="\n")  # type: ignore[arg-type]

    def write(self, row: Mapping[str, float]) -> None:
        """Append one line."""
        self._writer(self._file).writerow({name: _short(value) for name, value in row.items()})
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _short(value: float | str) -> float | str:
    return format(value, ".6g") if isinstance(value, float) else value


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file that :class:`CsvLog` wrote; none if it is absent.

    A row that a full disk or a kill has torn is left out: its last figure may have lost digits.
    """
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        whole = [line for line in file if line.endswith("\n")]
    # DictReader gives what a short row lacks as None, and what a long one has too much under None.
    rows = [row for row in csv.DictReader(whole) if None not in row and None not in row.values()]
    return [row for row in rows if row.get("decisions")]


class Logs:
    """All logs of a run: ``metrics.csv``, ``evaluation.csv``, the progress, and the ``further`` ones.

    Args:
        folder: of the run.
        config: its length, and whether progress is shown.
        actions: A, for the columns of their shares.
        decisions: where the run starts (a resumed one).
        further: more logs for the rows of ``metrics.csv`` and of the evaluations.
    """

    def __init__(
        self, folder: Path, config: TrainingConfig, actions: int, decisions: int, further: Sequence[Log]
    ) -> None:
        shares = [f"action_{i}_share" for i in range(actions)]
        self.folder, self.first, self.further = folder, decisions, list(further)
        self.metrics = CsvLog(folder / "metrics.csv", [*COLUMNS, *shares], decisions)
        self.evaluation: CsvLog | None = None
        before = read_rows(folder / "evaluation.csv")
        if before:  # of a resumed run; rows beyond its checkpoint go
            self.evaluation = CsvLog(folder / "evaluation.csv", list(before[0]), decisions)
        self.progress = Progress(config.total_decisions, decisions) if config.progress else None
        self._last, self._last_s = decisions, monotonic()

    def write(self, row: Mapping[str, float]) -> None:
        """A row of metrics; the rate since the last one is added."""
        now = monotonic()
        rate = (row["decisions"] - self._last) / max(now - self._last_s, 1e-9)
        self._last, self._last_s = int(row["decisions"]), now
        row = {**row, "decisions_per_s": rate}
        for log in [self.metrics, self.progress, *self.further]:
            if log is not None:
                log.write(row)

    def write_evaluation(self, row: Mapping[str, float]) -> None:
        """A row of evaluation figures; the columns of ``evaluation.csv`` are the first row's."""
        if self.evaluation is None:
            self.evaluation = CsvLog(self.folder / "evaluation.csv", list(row), self.first)
        self.evaluation.write(row)
        for log in self.further:
            log.write({name if name == "decisions" else f"evaluation/{name}": value for name, value in row.items()})

    def advance(self, decisions: int) -> None:
        """Move the progress bar."""
        if self.progress is not None:
            self.progress.advance(decisions)

    def say(self, text: str) -> None:
        """A line to the user, above the bar if there is one."""
        tqdm.write(text, file=sys.stderr)

    def close(self) -> None:
        """Close all of them."""
        for log in [self.metrics, self.evaluation, self.progress, *self.further]:
            if log is not None:
                log.close()
