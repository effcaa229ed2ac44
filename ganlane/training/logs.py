"""Logs of a training run: CSV files and progress; optionally TensorBoard or Weights & Biases."""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from datetime import timedelta
from importlib import import_module
from pathlib import Path
from time import monotonic
from typing import Any, Protocol

from tqdm import tqdm

from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.settings.train import LoggerConfig

#: Columns of ``metrics.csv``; the share of each action follows.
COLUMNS = (
    "decisions",
    "updates",
    "wall_s",
    "decisions_per_s",
    # of the episodes that ended since the last row
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
    # of the updates since the last row
    "loss",
    "mean_q",
    "clamped_fraction",
    "priority",
    "gradient_norm",
    # at present
    "sigma",
    "epsilon",
)
#: Figures of the progress, and their formats.
SHOWN = {
    "mean_return": "return {:.1f}",
    "crash_rate": "crashes {:.1%}",
    "out_of_road_rate": "off the road {:.1%}",
    "goal_rate": "goals {:.1%}",
}
#: Format of the bar; rate and remaining time are those of the last seconds.
BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} decisions, {rate_noinv_fmt}, {remaining} left{postfix}"


class Log(Protocol):
    """Receives a row of figures per logging interval."""

    def write(self, row: Mapping[str, float]) -> None:
        """Write one row; it holds ``decisions``."""

    def close(self) -> None:
        """Close the log."""


class Logs:
    """All logs of a run: ``metrics.csv``, ``evaluation.csv``, the progress, and further ones.

    Args:
        folder: of the run.
        actions: A, for the columns of their shares.
        decisions: already made (in a resumed run).
        total: decisions of the whole run, for the progress; None: no progress is shown.
        further: get the rows of ``metrics.csv`` and of the evaluations.
    """

    def __init__(
        self,
        folder: str | Path,
        actions: int,
        decisions: int,
        total: int | None,
        further: Sequence[Log] = (),
    ) -> None:
        self.evaluation_file = Path(folder) / "evaluation.csv"
        shares = [f"action_{i}_share" for i in range(actions)]
        metrics = CsvLog(Path(folder) / "metrics.csv", [*COLUMNS, *shares], decisions)
        self.progress = [] if total is None else [Progress(total, decisions)]
        self.further = further
        self.of_metrics: list[Log] = [metrics, *further, *self.progress]

        before = read_rows(self.evaluation_file)
        if before:
            # A resumed run: remove rows beyond its checkpoint.
            columns = list(before[0])
            CsvLog(self.evaluation_file, columns, decisions).close()

        # Decisions and time of the last row, for the rate.
        self._last = decisions
        self._last_s = monotonic()

    def write(self, row: Mapping[str, float]) -> None:
        """Write a row of metrics, with the decisions per second since the last one."""
        # Since the last row, whatever the rows before the resume say.
        now = monotonic()
        interval_s = max(now - self._last_s, 1e-9)
        rate = (row["decisions"] - self._last) / interval_s
        self._last = int(row["decisions"])
        self._last_s = now
        for log in self.of_metrics:
            log.write({**row, "decisions_per_s": rate})

    def write_evaluation(self, row: Mapping[str, float]) -> None:
        """Write a row of evaluation figures.

        It replaces one at the same decisions from before the run was resumed.
        """
        # Opened for one row: the columns are known only with the first evaluation.
        # Less 1: a row at the same decisions, from before a resume, is replaced.
        last = int(row["decisions"]) - 1
        with closing(CsvLog(self.evaluation_file, list(row), last)) as evaluation:
            evaluation.write(row)

        # With a prefix, so that these figures are not mixed with those of the training.
        figures = {f"evaluation/{name}": value for name, value in row.items()}
        for log in self.further:
            log.write({**figures, "decisions": row["decisions"]})

    def advance(self, decisions: int) -> None:
        """Move the progress bar."""
        for progress in self.progress:
            progress.advance(decisions)

    def say(self, text: str) -> None:
        """Print a line, above the bar if there is one."""
        # A plain print would break the bar.
        tqdm.write(text, file=sys.stderr)

    def close(self) -> None:
        """Close all logs."""
        for log in self.of_metrics:
            log.close()


class CsvLog:
    """A CSV file with fixed columns, flushed after every row.

    Args:
        path: the file; if it exists, its complete rows up to ``decisions`` are kept: a resumed run
            continues at its checkpoint, not where it was interrupted.
        columns: in this order; other entries of a row are dropped, missing ones left empty.
        decisions: already made.
    """

    def __init__(self, path: str | Path, columns: Sequence[str], decisions: int = 0) -> None:
        self.path = Path(path)
        # Rows after the checkpoint are made again.
        rows = [row for row in read_rows(self.path) if float(row["decisions"]) <= decisions]
        form: Any = {
            "fieldnames": columns,
            "extrasaction": "ignore",
            "lineterminator": "\n",
        }
        with atomic_path(self.path) as part, part.open("w", newline="") as file:
            # The columns of today, even if the old file had others.
            writer = csv.DictWriter(file, **form)
            writer.writeheader()
            writer.writerows(rows)

        # Opened anew, since the rewritten file has taken the place of the old one.
        self._file = self.path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, **form)

    def write(self, row: Mapping[str, float]) -> None:
        """Append one line."""
        # Six digits are enough to plot, and a fraction of the size.
        short = {
            name: format(value, ".6g") if isinstance(value, float) else value
            for name, value in row.items()
        }
        self._writer.writerow(short)
        # At once, so that a killed run keeps its rows and the file can be watched.
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file of :class:`CsvLog`; none if it is absent.

    A row cut off by a full disk or a kill is left out, since its last figure may lack digits.

    Raises:
        UserError: an entry is not a number.
    """
    if not path.is_file():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            # The last line may be cut off.
            whole = [line for line in file if line.endswith("\n")]

        # DictReader gives missing entries of a short row as None, and surplus ones of a long row
        # under the key None.
        reader = csv.DictReader(whole)
        rows = [row for row in reader if None not in row and None not in row.values()]
        if whole and "decisions" not in (reader.fieldnames or ()):
            raise ValueError("it has no column 'decisions'")

        rows = [row for row in rows if row["decisions"]]
        for row in rows:
            # Every entry has to be a number, or empty.
            numbers = {name: float(value) for name, value in row.items() if value}
            if not 0.0 <= numbers["decisions"] < float("inf"):
                raise ValueError(f"decisions={row['decisions']}")
    except (ValueError, csv.Error) as error:
        reason = str(error)[:100]
        raise UserError(
            f"{path}: damaged ({reason}); repair it, or move it away to go on without its rows."
        ) from error
    return rows


class Progress:
    """Shows decisions per second, remaining time and the figures :data:`SHOWN`.

    Figures that a row lacks, because no episode ended in its interval, keep their last value. Of
    the ``total`` decisions of the run, ``done`` have been made before. If stderr is a terminal it
    gets a bar, else a line per row.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        self.total = total
        self.figures: dict[str, float] = {}
        # Without a terminal its methods do nothing.
        self._bar = tqdm(
            total=total,
            initial=done,
            desc="train",
            unit="",
            unit_scale=True,
            dynamic_ncols=True,
            bar_format=BAR,
            disable=not sys.stderr.isatty(),
        )

    def advance(self, decisions: int) -> None:
        """Move the bar to ``decisions``."""
        self._bar.update(decisions - self._bar.n)

    def write(self, row: Mapping[str, float]) -> None:
        """Show a row of figures."""
        # A row without ended episodes lacks some of them.
        self.figures |= row
        shown = []
        for name, form in SHOWN.items():
            if name in self.figures:
                shown.append(form.format(self.figures[name]))
        if not self._bar.disable:
            self._bar.set_postfix_str(", ".join(shown))
            return

        # The bound avoids a division by 0 where there is no rate yet.
        rate = max(row.get("decisions_per_s", 0.0), 1e-9)
        # Remaining time at the rate of the last interval.
        decisions_left = max(self.total - row["decisions"], 0.0)
        left = timedelta(seconds=round(decisions_left / rate))
        head = f"{int(row['decisions']):,} of {self.total:,} decisions, {rate:,.0f}/s, {left} left"
        print(", ".join([head, *shown]), file=sys.stderr, flush=True)

    def close(self) -> None:
        """Stop updating the bar and leave it on the screen."""
        self._bar.close()


def make_logs(
    options: LoggerConfig, folder: str | Path, about: Mapping[str, Any] | None = None
) -> list[Log]:
    """The logs of ``logger=...`` beyond the CSV files; ``about``: JSON-serialisable settings of the
    run, for display.

    Raises:
        UserError: a package is not installed.
    """
    if options.kind == "tensorboard":
        return [TensorBoardLog(Path(folder) / "tensorboard")]
    if options.kind == "wandb":
        return [WandbLog(folder, options.project, about)]
    return []


def _module(name: str, extra: str) -> Any:
    """The module that a log needs, from the extra of that name."""
    # Imported only when asked for: these logs are optional.
    try:
        return import_module(name)
    except ImportError as error:
        raise UserError(
            f"logger={extra}: {extra} is not installed; run `pip install 'ganlane[{extra}]'` or "
            "use logger=csv."
        ) from error


class TensorBoardLog:
    """TensorBoard event files in ``folder`` (extra ``tensorboard``)."""

    def __init__(self, folder: str | Path) -> None:
        self._writer = _module("torch.utils.tensorboard", "tensorboard").SummaryWriter(str(folder))

    def write(self, row: Mapping[str, float]) -> None:
        """Add every figure as a scalar over the decisions."""
        for name, value in row.items():
            if name != "decisions":
                self._writer.add_scalar(name, value, int(row["decisions"]))

    def close(self) -> None:
        """Flush and close."""
        self._writer.close()


class WandbLog:
    """A run of Weights & Biases below ``folder/wandb`` (extra ``wandb``), named after ``folder``'s
    last two parts.

    Offline, unless the environment variable ``WANDB_MODE`` asks for something else (``online``,
    ``disabled``). A resumed training is a new run there that starts at the decisions of the
    checkpoint. ``about`` holds JSON-serialisable settings, shown with the figures.

    Raises:
        UserError: wandb is not installed, or does not start (``WANDB_MODE=online`` without an
            account, for instance).
    """

    def __init__(
        self, folder: str | Path, project: str = "ganlane", about: Mapping[str, Any] | None = None
    ) -> None:
        wandb = _module("wandb", "wandb")
        mode = os.environ.get("WANDB_MODE") or "offline"
        folder = Path(folder)
        # Else W&B falls back to a temporary folder.
        folder.mkdir(parents=True, exist_ok=True)
        name = "/".join(folder.absolute().parts[-2:])

        try:
            # W&B's console would capture the stream of the progress bar.
            settings = wandb.Settings(console="off")
            self._run = wandb.init(
                project=project,
                name=name,
                dir=str(folder),
                mode=mode,
                config=dict(about or {}),
                settings=settings,
            )
        except (wandb.Error, ValueError) as error:
            raise UserError(
                f"logger=wandb with WANDB_MODE={mode}: W&B did not start ({error}); use "
                "WANDB_MODE=offline or logger=csv."
            ) from error

    def write(self, row: Mapping[str, float]) -> None:
        """Add every figure over the decisions."""
        figures = {name: value for name, value in row.items() if name != "decisions"}
        self._run.log(figures, step=int(row["decisions"]))

    def close(self) -> None:
        """Flush and close."""
        self._run.finish()
