"""Fills the disk under tiny training runs, or kills one of their collecting workers, and resumes
them to the end.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.torture import runs
from benchmarks.torture.tally import Tally

#: Size of the small disk.
DISK = 16 * 2**20


def disk(tally: Tally, count: int, seed: int, minutes: float, scratch: Path) -> None:
    """Disturb ``count`` runs: by turns a full tmpfs, writes that are refused, and a lost worker."""
    rng, end = random.Random(seed), time.monotonic() + 60.0 * minutes
    runs.warm_up()
    scheme = "idm_mobil, then idm_faults"
    whole = scratch / "whole"
    attempt, wall_s = runs.to_the_end(runs.command(scheme, seed, whole), scratch / "log")
    if attempt.status != 0:
        tally.fail(f"undisturbed run: {attempt}")
        return
    with small_disk() as small:
        for number in range(count):
            if time.monotonic() > end:
                return
            sort = number % 3
            if sort == 0 and small is not None:
                _full(
                    tally,
                    rng,
                    runs.command(scheme, seed, small / f"run-{number}"),
                    whole,
                    wall_s,
                    small,
                )
            elif sort < 2:
                _refused(tally, rng, runs.command(scheme, seed, scratch / f"run-{number}"), whole)
            else:
                folder = scratch / f"run-{number}"
                arguments = [
                    *runs.TINY,
                    *runs.WORKERS,
                    f"seed={seed + number}",
                    f"hydra.run.dir={folder}",
                ]
                _lost_worker(tally, rng, arguments)


@contextmanager
def small_disk() -> Iterator[Path | None]:
    """A tmpfs of :data:`DISK` bytes; None where mounting is not allowed."""
    folder = tempfile.mkdtemp(prefix="torture-disk-")
    line = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", folder]
    mounted = (
        shutil.which("mount") is not None
        and subprocess.run(line, capture_output=True).returncode == 0
    )
    try:
        yield Path(folder) if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", folder], check=True)
        os.rmdir(folder)


def _full(
    tally: Tally, rng: random.Random, arguments: list[str], whole: Path, wall_s: float, small: Path
) -> None:
    """The disk is full from a random instant on; there is room again when the run is resumed."""
    log, filler = whole.with_name("log"), small / "filler"
    after_s = rng.uniform(0.0, wall_s)
    child = runs.start(arguments, log)
    time.sleep(after_s)
    _fill(filler)
    attempt = runs.finish(child, log)
    filler.unlink()
    _resumed(tally, "full disks", f"disk full after {after_s:.2f} s", arguments, attempt, whole)
    shutil.rmtree(runs.folder_of(arguments), ignore_errors=True)


def _fill(path: Path) -> None:
    """Write until there is no room."""
    with path.open("wb", buffering=0) as file:
        for size in (2**16, 2**12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue


def _refused(tally: Tally, rng: random.Random, arguments: list[str], whole: Path) -> None:
    """From a certain write on every one is refused with ENOSPC."""
    log, first = whole.with_name("log"), rng.randrange(1, 25)
    attempt = runs.finish(runs.start(arguments, log, refuses_from(first)), log)
    _resumed(
        tally,
        "runs whose writes are refused",
        f"ENOSPC from write {first} on",
        arguments,
        attempt,
        whole,
    )


def refuses_from(first: int) -> Callable[[], None]:
    """Makes a child's writes fail from the one of this number on."""

    def prepare() -> None:
        fsync, count = os.fsync, iter(range(10**9))

        def refused(file: int) -> None:
            if next(count) >= first:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            fsync(file)

        os.fsync = refused

    return prepare


def _lost_worker(tally: Tally, rng: random.Random, arguments: list[str]) -> None:
    """One of two collecting processes is killed."""
    folder = runs.folder_of(arguments)
    log = folder.with_suffix(".log")
    child = runs.start(arguments, log)
    metrics, end = folder / "metrics.csv", time.monotonic() + runs.AT_MOST_S
    running = os.WEXITED | os.WNOHANG | os.WNOWAIT  # look, without collecting the status
    while (
        time.monotonic() < end
        and _lines(metrics) < 3
        and os.waitid(os.P_PID, child, running) is None
    ):
        time.sleep(0.01)
    found = _workers(child)
    if not found:
        attempt = runs.interrupted(child, log, 0.0, signal.SIGKILL)
        tally.fail(f"{' '.join(arguments)}: no worker to be found: {attempt.said[-300:]}")
        return
    os.kill(rng.choice(found), signal.SIGKILL)
    attempt = runs.finish(child, log)
    _resumed(tally, "lost workers", "kill -9 of a worker", arguments, attempt, None)


def _lines(path: Path) -> int:
    return len(path.read_bytes().splitlines()) if path.is_file() else 0


def _workers(parent: int) -> list[int]:
    """The collecting processes below a run."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [
        int(each)
        for each in children
        if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()
    ]


def _resumed(
    tally: Tally,
    kind: str,
    how: str,
    arguments: list[str],
    attempt: runs.Attempt,
    whole: Path | None,
) -> None:
    """Check how the run ended, resume it, and compare it with the undisturbed one if there is one."""
    folder = runs.folder_of(arguments)
    if attempt.status == 0:
        tally.what["disturbed too late"] += 1
        return
    where = f"{' '.join(arguments)}: {how}"
    tally.what[kind] += 1
    complaints = [line for line in attempt.said.splitlines() if line.startswith("ganlane train: ")]
    if attempt.status != 2 or attempt.traceback or len(complaints) != 1:
        tally.fail(
            f"{where}: not one sentence and status 2, but {attempt.status}: {attempt.said[-600:]}"
        )
    resumed, _ = runs.to_the_end(runs.again(arguments, folder), folder.with_suffix(".log"))
    if resumed.status != 0 or not runs.finished(folder):
        tally.fail(f"{where}: cannot be resumed: {resumed.said[-300:]}")
        return
    wrong = runs.differences(folder, whole or folder, exact=whole is not None)
    tally.what["resumed to the end"] += not wrong
    for each in wrong:
        tally.fail(f"{where}: {each}")
