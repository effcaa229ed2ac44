"""What ``ganlane train_generator`` shows and keeps of a fit."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from tqdm import tqdm

from ganlane.generator import FitResult, Progress

_ERRORS = ("ade_m", "fde_m", "end_m")


class FitProgress:
    """A bar on a terminal, elsewhere a line per evaluation; a context that closes the bar."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._best = math.inf

    def next_fit(self, name: str) -> None:
        """Told that another fit begins: everything starts anew."""
        self.__exit__(None, None, None)
        self._bar, self._best = None, math.inf
        print(name, file=sys.stderr, flush=True)

    def __call__(self, progress: Progress) -> None:
        """Called by the fit after every update."""
        if sys.stderr.isatty():
            self._move_bar(progress)
        elif progress.best < self._best or progress.update == progress.updates:
            self._best = progress.best
            left = progress.seconds / progress.update * (progress.updates - progress.update)
            head = f"{progress.update} of {progress.updates} updates, at most {left:.0f} s left"
            scores = f"validation score {progress.score:.4f}, best {progress.best:.4f}"
            print(f"{head}, {scores}", file=sys.stderr, flush=True)

    def _move_bar(self, progress: Progress) -> None:
        if self._bar is None:
            self._bar = tqdm(total=progress.updates, desc="fit", unit="update", file=sys.stderr)
        self._bar.update(progress.update - self._bar.n)
        if progress.score is not None:
            self._bar.set_postfix_str(f"validation score {progress.score:.4f}, best {progress.best:.4f}")

    def __enter__(self) -> FitProgress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()


def _by_kind(measured: Mapping[str, float]) -> dict[str, Any]:
    """``{"ade_m/mean": x, ..., "windows": n}`` as ``{"ade_m": {"mean": x, ...}, ..., "windows": n}``."""
    nested: dict[str, Any] = {}
    for name, value in measured.items():
        error, _, kind = name.partition("/")
        if kind:
            nested.setdefault(error, {})[kind] = value
        else:
            nested[name] = value
    return nested


def results_of(result: FitResult) -> dict[str, Any]:
    """The numbers of ``results.json``: errors over all held-out scenes, and per scene."""
    scenes = {name: _by_kind(values) for name, values in result.metrics.items() if name in result.data["held_out"]}
    other = {name: dict(values) for name, values in result.metrics.items() if name != "all" and name not in scenes}
    return {
        "preset": result.preset,
        **_by_kind(result.metrics["all"]),
        "scenes": scenes,
        **other,
        "data": result.data,
        "statistics": result.statistics,
        "updates": result.updates,
        "wall_s": result.seconds,
    }


def metrics_table(metrics: Mapping[str, Mapping[str, float]]) -> str:
    """ADE and FDE of the generator beside constant velocity on the held-out scenes, as text."""
    overall = _by_kind(metrics["all"])
    kinds = list(overall["ade_m"])
    errors = [error for error in _ERRORS if error in overall]
    lines = [
        f"{'held-out scenes':<20}"
        + "".join(f"{name.replace('_m', ', m'):>10}" for name in errors)
        + f"{'ADE to CV':>12}"
    ]
    baseline = overall["ade_m"]["constant_velocity"]
    for kind in kinds:
        change = 100.0 * (overall["ade_m"][kind] / baseline - 1.0)
        figures = "".join(f"{overall[error].get(kind, math.nan):>10.3f}" for error in errors)
        lines.append(f"{kind:<20}{figures}{change:>+10.1f} %")
    return "\n".join(lines)
