"""How far a run is: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TextIO

from tqdm import tqdm

#: Figures shown beside the rate, and how.
SHOWN = {
    "mean_return": "return {:.1f}",
    "crash_rate": "crashes {:.1%}",
    "out_of_road_rate": "off the road {:.1%}",
    "goal_rate": "goals {:.1%}",
}
#: The bar: the rate is that of the last seconds, the time left follows from it.
BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} decisions, {rate_noinv_fmt}, {remaining} left{postfix}"


class Progress:
    """A Log that shows rather than keeps: decisions per second, time left, mean return, ends of the episodes.

    Figures that a row lacks, since no episode ended in its interval, are shown as they were last.

    Args:
        total: decisions of the whole run.
        done: decisions already made (a resumed run).
        stream: where to; a terminal gets a bar, anything else a line per row.
    """

    def __init__(self, total: int, done: int = 0, stream: TextIO | None = None) -> None:
        self.total, self.stream = total, sys.stderr if stream is None else stream
        self.known: dict[str, float] = {}
        self._bar = None
        if self.stream.isatty():
            options = {"unit": "", "unit_scale": True, "dynamic_ncols": True, "bar_format": BAR, "file": self.stream}
            self._bar = tqdm(total=total, initial=done, desc="train", **options)

    def advance(self, decisions: int) -> None:
        """Move the bar to ``decisions``."""
        if self._bar is not None:
            self._bar.update(decisions - self._bar.n)

    def write(self, row: Mapping[str, float]) -> None:
        """Show the figures of one row."""
        self.known |= {name: row[name] for name in SHOWN if name in row}
        text = ", ".join(form.format(self.known[name]) for name, form in SHOWN.items() if name in self.known)
        if self._bar is not None:
            self._bar.set_postfix_str(text)
            return
        rate = max(row.get("decisions_per_s", 0.0), 1e-9)
        left = max(self.total - row["decisions"], 0.0) / rate
        head = f"{int(row['decisions']):,} of {self.total:,} decisions, {rate:,.0f}/s, {duration(left)} left"
        print(f"{head}, {text}" if text else head, file=self.stream, flush=True)

    def close(self) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.close()


def duration(seconds: float) -> str:
    """``1:02:03`` for 3723 s."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
