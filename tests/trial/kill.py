"""Ends tiny training runs at random instants and resumes them until they finish.

The final weights, the table and the metrics must be those of the undisturbed run, bit for bit. Each
run is a forked child of this process, which has imported everything: 2 s instead of 6. A child is a
process of its own, so ``kill -9`` of it is what it is to a user's run.
"""

from __future__ import annotations

import csv
import itertools
import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file

# All that a run imports late would be imported in every child.
import ganlane.commands.train
import ganlane.generator.checkpoint
import ganlane.training.phases  # noqa: F401
from ganlane.config.run import run_command

from .tally import FORK, Tally

train = partial(run_command, "train")
#: Seconds that an attempt may take; then it hangs.
AT_MOST_S = 300.0
_TINY = """
env.goal_m=12 env.decision_period_s=0.2 env.vehicles=4 agent=rainbow observation=lane_view
mask=legal log_every=48 evaluate_every=96 selection_episodes=2 checkpoint_every_s=0.02
num_envs=8 agent.hidden=[16,16] agent.batch_size=16 agent.warmup=32 agent.capacity=200
agent.decisions_per_update=16 evaluation.episodes=2 evaluation.agents=[mobil,random_legal]
logger.progress=false
"""
TINY = _TINY.split()
ONE_PHASE = ["traffic=idm_mobil", "init=none", "total_decisions=480"]
#: The second phase goes on with the agent of the first.
TWO_PHASES = [
    "init=none",
    "pretrain.total_decisions=240",
    "traffic@pretrain.traffic=idm_mobil",
    "total_decisions=240",
]
SCHEMES = (
    ONE_PHASE,
    [*TWO_PHASES, "traffic=gan"],
    [*TWO_PHASES, "traffic=gan_calibrated"],
    [*TWO_PHASES, "traffic=idm_faults", "agent.n_step=1", "mask=safe"],
)
#: Ways to end an attempt.
WAYS = ("kill -9", "kill -9 in the first second", "kill -9 in a write")


class Attempt(NamedTuple):
    """How an attempt ended: the exit status (negative: a signal), and what it said."""

    status: int | None
    said: str


def kill(tally: Tally, seed: int, end: float, scratch: Path) -> None:
    """Disturb runs, each three times or more, until the monotonic clock is at ``end``."""
    rng = random.Random(seed)
    torch.set_num_threads(1)  # more must not exist before a fork
    train(["traffic=idm", "total_decisions=0"])  # refused, after Hydra was loaded
    undisturbed: dict[int, tuple[Path, float]] = {}
    for number in itertools.count():
        if time.monotonic() > end:
            return
        scheme = number % len(SCHEMES)
        arguments = [*TINY, *SCHEMES[scheme], f"seed={seed}"]
        if scheme not in undisturbed:
            whole = scratch / f"whole-{scheme}"
            begun = time.monotonic()
            attempt = run([*arguments, f"hydra.run.dir={whole}"], scratch / "log")
            undisturbed[scheme] = whole, time.monotonic() - begun
            if attempt.status != 0:
                tally.fail(f"undisturbed: {' '.join(arguments)}: {attempt}")
                return
        folder = scratch / f"run-{number}"
        whole, wall_s = undisturbed[scheme]
        history = disturb(tally, rng, arguments, folder, wall_s)
        told = f"{' '.join(arguments)}: {history}"
        if not (folder / "results.json").is_file():
            tally.fail(f"{told}: ended without results")
            continue
        tally.what["runs"] += 1
        wrong = differences(folder, whole)
        tally.what["runs that ended bit for bit the same"] += not wrong
        for text in wrong:
            tally.fail(f"{told}: {text}")


def disturb(
    tally: Tally, rng: random.Random, arguments: list[str], folder: Path, wall_s: float
) -> list[str]:
    """Disturb a run three to five times, then leave it alone; what was done, in words."""
    log = folder.with_suffix(".log")
    history = []
    for way in [*rng.choices(WAYS, k=rng.randint(3, 5)), "left alone"]:
        # As the user goes on: by resume where there is a checkpoint, else with the same command.
        started = any(folder.rglob("last.pt"))
        line = [f"resume={folder}"] if started else [*arguments, f"hydra.run.dir={folder}"]
        write, share = rng.randrange(20), rng.random()
        prepare = torn_write(write, share) if way == "kill -9 in a write" else None
        after_s = None
        if prepare is None and way != "left alone":
            after_s = share * (1.0 if "first second" in way else wall_s)
        history.append(f"{way} (write {write}, share {share:.2f})")
        attempt = run(line, log, prepare, after_s)
        if attempt.status == 0:
            break
        if attempt.status != -signal.SIGKILL or "Traceback" in attempt.said:
            tally.fail(f"{history}: status {attempt.status}: {attempt.said[-300:]}")
        else:
            tally.what[way] += 1
    return history


def run(
    arguments: list[str],
    log: Path,
    prepare: Callable[[], None] | None = None,
    after_s: float | None = None,
) -> Attempt:
    """``ganlane train ARGUMENTS`` in a child, after ``prepare`` in it; how it ended.

    It is killed after ``after_s`` seconds, unless it has ended before.
    """
    child = FORK.Process(target=_train, args=(arguments, log, prepare))
    child.start()
    child.join(AT_MOST_S if after_s is None else after_s)
    hangs = child.is_alive() and after_s is None
    child.kill()
    child.join()
    said = log.read_text(errors="replace")
    if hangs:
        return Attempt(None, f"hung for {AT_MOST_S:g} s: {said}")
    return Attempt(child.exitcode, said)


def _train(arguments: list[str], log: Path, prepare: Callable[[], None] | None) -> None:
    """Run the command in this child, and end it."""
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    if prepare is not None:
        prepare()
    sys.exit(train(arguments))


def torn_write(number: int, share: float) -> Callable[[], None]:
    """Makes a child kill itself in its write ``number``, with ``share`` of it on the disk."""

    def prepare() -> None:
        fsync = os.fsync
        writes = 0

        def counted(file: int) -> None:
            nonlocal writes
            writes += 1
            if writes > number:
                os.ftruncate(file, int(os.fstat(file).st_size * share))
                os.kill(os.getpid(), signal.SIGKILL)
            fsync(file)

        os.fsync = counted

    return prepare


def differences(folder: Path, whole: Path) -> list[str]:
    """What is not as in the folder of an undisturbed run."""
    wrong = [f"left behind: {path.relative_to(folder)}" for path in folder.rglob(".*.part")]
    for path in whole.rglob("agent.safetensors"):
        name = path.relative_to(whole)
        if _bits(path) != _bits(folder / name):
            wrong.append(f"other weights in {name}")
    tables = [json.loads((run / "results.json").read_text())["rows"] for run in (folder, whole)]
    if tables[0] != tables[1]:
        wrong.append("another table of the final evaluation")
    for path in [*whole.rglob("metrics.csv"), *whole.rglob("evaluation.csv")]:
        name = path.relative_to(whole)
        if _rows(folder / name) != _rows(path):
            wrong.append(f"other figures in {name}")
    return wrong


def _bits(path: Path) -> dict[str, bytes]:
    return {name: value.numpy().tobytes() for name, value in load_file(path).items()}


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV without what depends on the clock."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        for name in ("wall_s", "decisions_per_s"):
            row.pop(name, None)
    return rows
