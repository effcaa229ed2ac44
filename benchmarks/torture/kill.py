"""Kills tiny training runs at random and at chosen instants and resumes them until they end.

The final weights, the table and the metrics must be those of the undisturbed run, bit for bit.
"""

from __future__ import annotations

import random
import signal
import time
from pathlib import Path

from benchmarks.torture import runs
from benchmarks.torture.tally import Tally

#: Ways to end an attempt, and how often each is chosen.
WAYS = {
    "kill": 4,
    "first second": 2,
    "in a write": 4,
    "final evaluation": 2,
    "SIGTERM": 4,
    "SIGINT": 4,
}
SIGNALS = {"SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT}


def kill(
    tally: Tally, count: int, seed: int, minutes: float, scratch: Path, signals: bool = True
) -> None:
    """Disturb ``count`` runs, or as many as the minutes allow, each three times or more.

    Not only by kill -9.
    """
    rng, end = random.Random(seed), time.monotonic() + 60.0 * minutes
    runs.warm_up()
    wholes: dict[tuple[str, int], tuple[Path, float]] = {}
    schemes = list(runs.SCHEMES)
    ways = [
        way for way, often in WAYS.items() for _ in range(often) if signals or way not in SIGNALS
    ]
    for number in range(count):
        if time.monotonic() > end:
            return
        scheme, own = schemes[number % len(schemes)], seed + number // (3 * len(schemes))
        if (scheme, own) not in wholes:
            whole = scratch / f"whole-{schemes.index(scheme)}-{own}"
            attempt, wall_s = runs.to_the_end(runs.command(scheme, own, whole), scratch / "log")
            if attempt.status != 0:
                tally.fail(f"undisturbed run of {scheme}, seed {own}: {attempt}")
                continue
            wholes[scheme, own] = whole, wall_s
        whole, wall_s = wholes[scheme, own]
        _disturbed(
            tally, rng, runs.command(scheme, own, scratch / f"run-{number}"), whole, wall_s, ways
        )


def _disturbed(
    tally: Tally,
    rng: random.Random,
    arguments: list[str],
    whole: Path,
    wall_s: float,
    ways: list[str],
) -> None:
    """One run: disturbed three to five times, then left alone."""
    folder = runs.folder_of(arguments)
    log = folder.with_suffix(".log")
    history: list[str] = []
    for way in [*rng.choices(ways, k=rng.randint(3, 5)), None]:
        told = runs.again(arguments, folder)
        attempt, how = _attempt(rng, told, way, log, wall_s)
        history.append(how)
        if attempt.status == 0:
            break
        killed = attempt.status == -signal.SIGKILL
        if way in SIGNALS and attempt.status in (-SIGNALS[way], 128 + SIGNALS[way]):
            tally.what[way] += 1
        elif way not in SIGNALS and killed:
            tally.what["kill -9"] += 1
            tally.what[f"of them {way}" if way != "kill" else "of them anytime"] += 1
        else:
            tally.fail(
                f"{' '.join(arguments)}: {history}: status {attempt.status}: {attempt.said[-300:]}"
            )
            return
        if attempt.traceback:
            tally.fail(f"{' '.join(arguments)}: {history}: a traceback: {attempt.said[-300:]}")
    if not runs.finished(folder):
        tally.fail(f"{' '.join(arguments)}: {history}: ended without results")
        return
    tally.what["runs"] += 1
    wrong = runs.differences(folder, whole)
    tally.what["runs that ended bit for bit the same"] += not wrong
    for each in wrong:
        tally.fail(f"{' '.join(arguments)}: {history}: {each}")


def _attempt(
    rng: random.Random, arguments: list[str], way: str | None, log: Path, wall_s: float
) -> tuple[runs.Attempt, str]:
    """One attempt that is ended in a ``way`` (None: left alone), and what was done in words."""
    prepare, after_s, number = None, None, signal.SIGKILL
    how = str(way)
    if way == "in a write":
        write, share = rng.randrange(12), rng.random()
        prepare, how = runs.dies_in_write(write, share), f"kill -9 in write {write} at {share:.0%}"
    elif way == "final evaluation":
        delay = rng.uniform(0.0, 0.3)
        prepare, how = (
            runs.dies_in_evaluation(delay),
            f"kill -9 {delay:.2f} s into the final evaluation",
        )
    elif way is not None:
        number = SIGNALS.get(way, signal.SIGKILL)
        # A resumed run is shorter than a whole one.
        after_s = rng.uniform(0.0, 1.0 if way == "first second" else 0.6 * wall_s)
        how = f"{signal.Signals(number).name} after {after_s:.2f} s"
    child = runs.start(arguments, log, prepare)
    if after_s is not None:
        return runs.interrupted(child, log, after_s, number), how
    return runs.finish(child, log), how
