"""Where the time of the training loop goes: timers round its calls, in a repetition of its own."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torchrl.envs import TransformedEnv

from ganlane.benchmarks.train_loop import advance
from ganlane.training.checkpoint import TrainingState

SIMULATOR, TRAFFIC = "simulator", "traffic"
OBSERVATION, SHELL = "observation and reward", "TorchRL's environment"
POLICY = "policy"
WINDOW, STORE, SAMPLE, PRIORITIES = "window", "store", "sample", "priorities"
LOSS, BACKWARD, OPTIMISER, UPDATE = "loss", "backward", "optimiser", "noise, clipping, target"
REST = "rest"
#: Part of the loop to what it consists of; a part without parts stands for itself.
PARTS: dict[str, tuple[str, ...]] = {
    SIMULATOR: (),
    TRAFFIC: (),
    OBSERVATION: (),
    SHELL: (),
    POLICY: (),
    "replay": (WINDOW, STORE, SAMPLE, PRIORITIES),
    "learning": (LOSS, BACKWARD, OPTIMISER, UPDATE),
    REST: (),
}


class Clock:
    """Wall time by part; a part that runs inside another one is charged to itself alone, so that all add up."""

    def __init__(self, device: str = "cpu") -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._running, self._cuda = [REST], device == "cuda"
        self._since = time.perf_counter()

    def timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """``function``, its time charged to ``part``."""

        def call(*arguments: Any, **named: Any) -> Any:
            self._charge()
            self._running.append(part)
            try:
                return function(*arguments, **named)
            finally:
                self._charge()
                self._running.pop()

        return call

    def shares(self) -> dict[str, float]:
        """Share of each part in the time since the clock was made; they sum to 1."""
        self._charge()
        total = sum(self.seconds.values())
        return {part: spent / total for part, spent in self.seconds.items()}

    def _charge(self) -> None:
        """The time since the last change goes to the part that was running."""
        if self._cuda:
            torch.cuda.synchronize()
        now = time.perf_counter()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now


@contextmanager
def instrumented(calls: Sequence[tuple[Any, str, str]], clock: Clock) -> Iterator[None]:
    """Inside, every call ``owner.name()`` of ``calls`` (owner, name, part) is timed."""
    before = [(owner, name, vars(owner).get(name)) for owner, name, _ in calls]
    for owner, name, part in calls:
        _put(owner, name, clock.timed(getattr(owner, name), part))
    try:
        yield
    finally:
        for owner, name, own in before:
            _put(owner, name, own)


def _put(owner: Any, name: str, function: Callable[..., Any] | None) -> None:
    """Shadow a method by an attribute of the object, past what modules do with attributes; None: no longer."""
    if function is None:
        del vars(owner)[name]
    else:
        vars(owner)[name] = function


def calls_of(run: TrainingState, env: TransformedEnv) -> list[tuple[Any, str, str]]:
    """What is timed of a run in ``env``: owner, name, part."""
    agent, replay = run.agent, run.agent.replay
    base, transform = env.base_env, env.transform
    return [
        (env, "step_and_maybe_reset", SHELL),
        (base, "_step", SIMULATOR),
        (base, "_reset", SIMULATOR),
        (base.traffic, "forward", TRAFFIC),
        (base.traffic, "init_memory", TRAFFIC),
        (transform, "_step", OBSERVATION),
        (transform, "_reset", OBSERVATION),
        (agent.policy, "forward", POLICY),
        (run.window, "push", WINDOW),
        (agent, "store", STORE),
        (agent, "update", UPDATE),
        (replay, "sample", SAMPLE),
        (replay, "update_priority", PRIORITIES),
        (agent.loss, "forward", LOSS),
        (torch.autograd, "backward", BACKWARD),
        (agent.optimizer, "step", OPTIMISER),
    ]


def take_shares(
    run: TrainingState, env: TransformedEnv, decisions: int, device: str = "cpu"
) -> tuple[dict[str, float], float]:
    """Shares of the parts in ``decisions`` of every environment, and how many all together made per second."""
    clock, began = Clock(device), time.perf_counter()
    with instrumented(calls_of(run, env), clock):
        advance(run, decisions)
    shares = clock.shares()
    return shares, decisions * run.environments / (time.perf_counter() - began)


def totals(shares: dict[str, float]) -> dict[str, float]:
    """Shares of whole parts: those of :data:`PARTS`."""
    return {part: sum(shares.get(name, 0.0) for name in names or (part,)) for part, names in PARTS.items()}
