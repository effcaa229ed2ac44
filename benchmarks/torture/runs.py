"""Tiny training runs, each in a forked child of this process, which has imported everything: 2 s
instead of 6.

A child is a process of its own, so ``kill -9`` of it is what it is to a user's run.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

import ganlane.commands.train
import ganlane.generator.checkpoint
import ganlane.traffic.presets
import ganlane.training.phases
import ganlane.training.workers
from ganlane.agents import read_agent
from ganlane.train import main as train

#: Seconds that an attempt may take; then it hangs.
AT_MOST_S = 300.0
TINY = (
    *("env.goal_m=12", "env.decision_period_s=0.2", "env.vehicles=4"),
    *("agent=rainbow", "observation=lane_view", "mask=legal", "log_every=48", "evaluate_every=96"),
    *(
        "selection_episodes=2",
        "checkpoint_every_s=0.02",
        "collector.num_envs=8",
        "agent.hidden=[16,16]",
    ),
    *(
        "agent.batch_size=16",
        "agent.warmup=32",
        "agent.capacity=200",
        "agent.decisions_per_update=16",
    ),
    *("evaluation.episodes=2", "evaluation.agents=[mobil,random_legal]", "logger.progress=false"),
)
FIRST = (
    "init=none",
    "pretrain.total_decisions=240",
    "traffic@pretrain.traffic=idm_mobil",
    "total_decisions=240",
)
#: One phase, and two of which the second goes on with the agent of the first.
SCHEMES = {
    "idm_mobil": ("traffic=idm_mobil", "init=none", "total_decisions=480"),
    "idm_mobil, then gan": (*FIRST, "traffic=gan"),
    "idm_mobil, then gan_calibrated": (*FIRST, "traffic=gan_calibrated"),
    "idm_mobil, then idm_faults": (*FIRST, "traffic=idm_faults", "agent.n_step=1", "mask=safe"),
}
#: Two collecting workers; without lost ones, such a run is not the same twice either.
WORKERS = (
    *(
        "traffic=idm_mobil",
        "init=none",
        "total_decisions=960",
        "collector=multi",
        "collector.workers=2",
    ),
    "collector.weights_every=32",
)


@dataclass(frozen=True)
class Attempt:
    """How an attempt ended: the exit status (negative.

    The signal that ended it), and what it said on stderr.
    """

    status: int | None
    said: str

    @property
    def traceback(self) -> bool:
        """Whether it ended in one."""
        return "Traceback" in self.said


def start(arguments: list[str], log: Path, prepare: Callable[[], None] | None = None) -> int:
    """Begin ``ganlane train ARGUMENTS`` in a child, after ``prepare`` in it; its process id."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        os.setpgid(0, 0)
        with log.open("w") as file:
            for stream in (1, 2):
                os.dup2(file.fileno(), stream)
        if prepare is not None:
            prepare()
        status = train(arguments)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def finish(child: int, log: Path, at_most_s: float = AT_MOST_S) -> Attempt:
    """Wait until the child has ended; its workers are gone then, too."""
    end = time.monotonic() + at_most_s
    found = 0
    while found == 0 and time.monotonic() < end:
        found, code = os.waitpid(child, os.WNOHANG)
        time.sleep(0.002)
    if found == 0:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return Attempt(None, f"hung for {at_most_s:g} s: {log.read_text(errors='replace')}")
    return Attempt(os.waitstatus_to_exitcode(code), log.read_text(errors="replace"))


def interrupted(child: int, log: Path, after_s: float, number: int) -> Attempt:
    """Send the child a signal after so many seconds, unless it has ended before."""
    end = time.monotonic() + after_s
    while (
        time.monotonic() < end
        and os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
    ):
        time.sleep(0.001)
    os.kill(child, number)  # not yet waited for, so the number is still its own
    return finish(child, log)


def to_the_end(arguments: list[str], log: Path) -> tuple[Attempt, float]:
    """The whole run without any disturbance, and its seconds."""
    began = time.monotonic()
    return finish(start(arguments, log), log), time.monotonic() - began


def warm_up() -> None:
    """What the first command of a process loads once; torch's threads must not exist before a fork."""
    torch.set_num_threads(1)
    train(["traffic=idm", "total_decisions=0"])  # refused, after the configuration was composed


def command(scheme: str, seed: int, folder: Path) -> list[str]:
    """Command line of a run into ``folder``."""
    return [*TINY, *SCHEMES[scheme], f"seed={seed}", f"hydra.run.dir={folder}"]


def folder_of(arguments: list[str]) -> Path:
    """The run folder that a command line names."""
    return Path(arguments[-1].partition("=")[2])


def again(arguments: list[str], folder: Path) -> list[str]:
    """How the user goes on.

    With ``resume`` where there is a checkpoint, else with the same command.
    """
    return [f"resume={folder}"] if any(folder.rglob("last.pt")) else arguments


def finished(folder: Path) -> bool:
    """Whether the run has its results."""
    return (folder / "results.json").is_file()


def differences(folder: Path, whole: Path, exact: bool = True) -> list[str]:
    """What is not as it should be in a run's folder, beside that of an undisturbed run."""
    wrong = [f"left behind: {path.relative_to(folder)}" for path in folder.rglob(".*.part")]
    for name in ("evaluation.csv", "pretrain/evaluation.csv"):
        rows = [row["decisions"] for row in _rows(folder / name)]
        if len(set(rows)) < len(rows):
            wrong.append(f"{name} repeats a row: {rows}")
    if not exact:
        return wrong
    for name in ("agent.safetensors", "pretrain/agent.safetensors"):
        if (whole / name).is_file() and not same_weights(folder / name, whole / name):
            wrong.append(f"other weights in {name}")
    one, other = (
        json.loads((each / "results.json").read_text())["rows"] for each in (folder, whole)
    )
    if one != other:
        wrong.append("another table of the final evaluation")
    for name in ("metrics.csv", "pretrain/metrics.csv"):
        if _figures(folder / name) != _figures(whole / name):
            wrong.append(f"other figures in {name}")
    return wrong


def same_weights(one: Path, other: Path) -> bool:
    """Whether two agents are the same bit for bit."""
    a, b = read_agent(one)[0], read_agent(other)[0]
    return a.keys() == b.keys() and all(
        torch.equal(a[name].view(torch.uint8), b[name].view(torch.uint8))
        if a[name].dim()
        else a[name] == b[name]
        for name in a
    )


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.open(newline=""))) if path.is_file() else []


def _figures(path: Path) -> list[dict[str, str]]:
    """The rows without what depends on the clock."""
    clock = ("wall_s", "decisions_per_s")
    return [
        {name: value for name, value in row.items() if name not in clock} for row in _rows(path)
    ]


def dies_in_write(number: int, share: float) -> Callable[[], None]:
    """Makes a child kill itself in its write ``number``, when ``share`` of the bytes have reached
    the disk.
    """

    def prepare() -> None:
        fsync, count = os.fsync, iter(range(10**9))

        def torn(file: int) -> None:
            if next(count) == number:
                os.ftruncate(file, int(os.fstat(file).st_size * share))
                fsync(file)
                os.kill(os.getpid(), signal.SIGKILL)
            fsync(file)

        os.fsync = torn

    return prepare


def dies_in_evaluation(after_s: float, number: int = signal.SIGKILL) -> Callable[[], None]:
    """Makes a child get a signal ``after_s`` seconds after its final evaluation has begun."""

    def prepare() -> None:
        compare = ganlane.commands.train.compare

        def watched(*arguments: object, **options: object) -> object:
            parent = os.getpid()
            if os.fork() == 0:  # a timer of its own, which no handler of the run can delay
                time.sleep(after_s)
                os.kill(parent, number)
                os._exit(0)
            return compare(*arguments, **options)

        ganlane.commands.train.compare = watched

    return prepare
