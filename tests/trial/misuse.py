"""Gives every argument of the API what it does not take: each call must work, or end in one
sentence.

Steps, resets and actions that are wrong are in tests/test_env_misuse.py.
"""

from __future__ import annotations

import inspect
import io
import random
import time
import warnings
from contextlib import redirect_stderr, redirect_stdout
from typing import Any
from unittest.mock import Mock, patch

import gymnasium
import numpy as np
import torch

import ganlane
import ganlane.commands.train
from ganlane.errors import UserError

from .damage import traceback_of
from .tally import Tally, forked

AT_MOST_S = 60.0

#: Given to every argument.
VALUES: list[Any] = [
    *(None, True, -1, 0, 3, 2**63, 10**30, -0.5, 1.5, float("nan"), float("inf")),
    *("", "x", "\x00", "a" * 10**5, "os.system", b"x", print, object(), 1j, range(3)),
    *([], ["x"], [1, None], (), {}, {"name": 3}, {"x": 1}, {1: 2}, {3}),
    *(np.float32(1.5), np.array([1, 2]), torch.tensor(1.5), torch.float16),
]


def make(**keys: Any) -> Any:
    """Two decisions of an environment."""
    return ganlane.make_env(**keys).rollout(2)


def train(**keys: Any) -> Any:
    """The checks, and what a command does around them; the training itself would take seconds."""
    quick = {"total_decisions": 16, "num_envs": 4, "traffic": "idm"}
    stopped = Mock(side_effect=UserError("stopped"))
    with patch.object(ganlane.commands.train, "train", stopped):
        return ganlane.api.train(**(quick | keys))


def evaluate(**keys: Any) -> Any:
    """Of one short episode."""
    quick = {"agents": ["mobil"], "traffics": ["idm"], "episodes": 1, "goal_m": 20.0}
    return ganlane.api.evaluate(**(quick | keys))


def gym(**keys: Any) -> Any:
    """A step of one environment of gymnasium's."""
    env = gymnasium.make("ganlane/Highway-v0", disable_env_checker=True, **keys)
    env.reset(seed=0)
    return env.step(0)


#: The calls, and whose arguments they take; further ones are keys of the environment.
CALLS = {
    "make_env": (make, ganlane.make_env),
    "load_agent": (ganlane.load_agent, ganlane.load_agent),
    "api.train": (train, ganlane.api.train),
    "api.evaluate": (evaluate, ganlane.api.evaluate),
    "gymnasium.make": (gym, ganlane.make_env),
}
#: What gymnasium.make does not hand on, or has by another name.
NOT_GYMNASIUMS = ("num_envs", "device", "transforms")


def all_calls() -> list[tuple[str, str, int]]:
    """Name of a call, argument, and place of the value."""
    calls = []
    for name, (_, signature) in CALLS.items():
        parameters = inspect.signature(signature).parameters.values()
        arguments = [item.name for item in parameters if item.kind != item.VAR_KEYWORD]
        if name == "gymnasium.make":
            arguments = [argument for argument in arguments if argument not in NOT_GYMNASIUMS]
        for argument in [*arguments, "lanes", "goal_m", "idm"]:
            calls += [(name, argument, place) for place in range(len(VALUES))]
    return calls


def misuse(tally: Tally, seed: int, minutes: float) -> None:
    """All calls in random order, or as many as the minutes allow."""
    end = time.monotonic() + 60.0 * minutes
    calls = all_calls()
    random.Random(seed).shuffle(calls)
    for (name, argument, place), result in forked(outcome, calls, AT_MOST_S, memory_gib=16.0):
        tally.what["calls"] += 1
        kind = result.split(maxsplit=1)[0].rstrip(":")
        tally.what[kind.lower()] += 1
        if kind not in ("REFUSED", "WORKED"):
            tally.fail(f"{name}({argument}={VALUES[place]!r:.60}): {result}")
        if time.monotonic() > end:
            return


def outcome(call: tuple[str, str, int]) -> str:
    """How a call ended, in words that begin with one in capitals."""
    name, argument, place = call
    said = io.StringIO()
    try:
        with redirect_stderr(said), redirect_stdout(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            CALLS[name][0](**{argument: VALUES[place]})
    # gymnasium's own wrappers speak first in places.
    except (UserError, gymnasium.error.Error) as error:
        return f"LINES {error}" if "\n" in str(error) else f"REFUSED {error}"[:100]
    except BaseException as error:
        # The file system's own refusal passes.
        if isinstance(error, OSError) and error.errno is not None:
            return f"REFUSED {error}"
        return f"TRACEBACK {traceback_of(error)}"
    return "WORKED"
