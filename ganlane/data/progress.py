"""How far a transfer or a long reading is: a bar on a terminal, elsewhere a line every so often."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Final

from tqdm import tqdm

#: Seconds between two lines where there is no terminal.
LINE_EVERY_S: Final = 10.0


class ByteProgress:
    """Bytes done, with rate and time left; a context that closes the bar.

    Args:
        what: the word in front, ``download`` or ``read``.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._bar: tqdm | None = None
        self._begun = time.monotonic()
        self._told = self._begun
        self._first: int | None = None

    def __call__(self, done: int, total: int | None) -> None:
        """Called with the bytes done so far and the total, None where that is unknown."""
        self._first = done if self._first is None else self._first
        if sys.stderr.isatty():
            self._bar = self._bar or tqdm(
                total=total, initial=done, desc=self._what, unit="B", unit_scale=True, file=sys.stderr
            )
            self._bar.update(done - self._bar.n)
        elif time.monotonic() - self._told >= LINE_EVERY_S:
            self._told = time.monotonic()
            print(self.line(done, total), file=sys.stderr, flush=True)

    def line(self, done: int, total: int | None) -> str:
        """``read: 120 of 1200 MB, 40.0 MB/s, 27 s left``."""
        rate = (done - (self._first or 0)) / max(time.monotonic() - self._begun, 1e-3)
        share = f"{done / 1e6:.0f} MB" if total is None else f"{done / 1e6:.0f} of {total / 1e6:.0f} MB"
        left = f", {(total - done) / rate:.0f} s left" if total is not None and rate > 0.0 else ""
        return f"{self._what}: {share}, {rate / 1e6:.1f} MB/s{left}"

    def __enter__(self) -> ByteProgress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
