"""What the checks cost a training: the same run with and without them, in turns."""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

import torch

from benchmarks.torture.tally import Tally
from ganlane.config.command_line import check
from ganlane.env import highway
from ganlane.traffic.base import TrafficModule
from ganlane.training import checkpoint
from ganlane.training.checkpoint import Checkpointer, TrainingState
from ganlane.training.loop import advance
from ganlane.training.phases import identity, make_collector, make_initial_agent, phases_of

#: The share of the time that the checks may take.
AT_MOST = 0.01
RUNS = {
    "idm_mobil, native kernel": ["traffic=idm_mobil", "env.kernel=auto"],
    "idm_mobil, tensor code": ["traffic=idm_mobil", "env.kernel=torch"],
    "gan": ["traffic=gan"],
}
#: Steps of all environments in a turn.
STEPS = 4
#: Pairs of checkpoints.
CHECKPOINTS = 5


@contextmanager
def without_checks() -> Iterator[None]:
    """Neither actions nor autocast are looked at, and files get no checksum."""
    with ExitStack() as stack:
        for owner, name, stand_in in (
            (highway, "checked_action", lambda action, rows, values=True: action),
            (TrafficModule, "__call__", TrafficModule.__call__.__wrapped__),  # type: ignore[attr-defined]
            (TrafficModule, "init_memory", TrafficModule.init_memory.__wrapped__),  # type: ignore[attr-defined]
            (checkpoint, "seal_archive", lambda path: None),
        ):
            stack.enter_context(patch.object(owner, name, stand_in))
        yield


def cost(tally: Tally, minutes: float, seed: int, scratch: Path) -> None:
    """The share of the time of a training that the checks take, for each of :data:`RUNS`.

    A third of it each.
    """
    torch.set_num_threads(1)
    for number, (name, options) in enumerate(RUNS.items()):
        folder = scratch / str(number)
        config = check(
            "train", [*options, "init=none", f"seed={seed}", f"hydra.run.dir={folder}"]
        ).config
        (phase,) = phases_of(config, folder)
        config, agent = make_initial_agent(config, phase, None)
        state = TrainingState(make_collector(config, phase), agent, identity(config, phase))
        while not agent.ready:
            advance(state)
        _turn(state)
        every_s = config.checkpoint_every_s
        steps, saves = _shares(state, minutes / len(RUNS), random.Random(seed), folder, every_s)
        share = steps + saves
        tally.what[f"{name}: {share:+.2%} ({steps:+.2%} in steps, {saves:+.2%} in checkpoints)"] = 1
        if share > AT_MOST:
            tally.fail(f"{name}: the checks take {share:.2%} of a training's time")


def _shares(
    state: TrainingState, minutes: float, rng: random.Random, folder: Path, every_s: float
) -> tuple[float, float]:
    """What the checks take in steps and in checkpoints, as shares of the time.

    Medians of pairs in random order.
    """
    saver = Checkpointer(state, folder, every_s, True, {})
    steps, saves, until = [], [], time.monotonic() + 60.0 * minutes
    while time.monotonic() < until or len(saves) < CHECKPOINTS:
        turns, checkpoints = {}, {}
        for checked in rng.sample((True, False), 2):
            with ExitStack() as stack:
                if not checked:
                    stack.enter_context(without_checks())
                turns[checked] = _turn(state)
                if len(saves) < CHECKPOINTS:
                    begun = time.monotonic()
                    saver.save()
                    # A longer one is followed by a longer pause.
                    checkpoints[checked] = (time.monotonic() - begun) / saver.pause_s
        steps.append(turns[True] / turns[False] - 1.0)
        if checkpoints:
            saves.append(checkpoints[True] - checkpoints[False])
    return statistics.median(steps), statistics.median(saves)


def _turn(state: TrainingState) -> float:
    """CPU seconds of some steps of the training loop."""
    begun = time.process_time()
    for _ in range(STEPS):
        advance(state)
    return time.process_time() - begun
