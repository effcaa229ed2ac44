"""Calls the API with what it does not take: each call must work, or end in one sentence.

And the ways to have code executed by a file or folder, which are tests:
``tests/test_no_code_from_files.py``.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import random
import re
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import gymnasium
import numpy as np
import torch

import ganlane
import ganlane.commands.train
from benchmarks.torture.damage import traceback_of
from benchmarks.torture.tally import Tally, forked
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.files import PACKAGE
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic

try:
    import ganlane.sb3
except (ImportError, UserError):  # the extra is not installed
    SB3 = False
else:
    SB3 = True

ROOT = Path(__file__).resolve().parents[2]
TESTS = "tests/test_no_code_from_files.py"
AT_MOST_S = 60.0


class Foreign:
    """Something that no argument can be."""

    def __repr__(self) -> str:
        return "Foreign()"


#: Given to every argument.
VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        -1,
        0,
        3,
        2**63,
        10**30,
        -0.5,
        1.5,
        float("nan"),
        float("inf"),
        1e300,
        "",
        "x",
        "\x00",
    ),
    *(
        "a" * 10**5,
        "os.system",
        [],
        ["x"],
        [1, None],
        (),
        {},
        {"name": 3},
        {"x": 1},
        {1: 2},
        b"x",
        {3},
        Foreign(),
    ),
    *(
        Foreign,
        print,
        np.float32(1.5),
        np.array([1, 2]),
        torch.tensor(1.5),
        torch.float16,
        1j,
        range(3),
    ),
)
#: What an action could be by mistake, for three rows.
ACTIONS: tuple[Any, ...] = (
    *(
        None,
        -1,
        3,
        2**40,
        1.5,
        float("nan"),
        "left",
        [],
        [0, 1],
        [0, 1, 2, 0],
        [0, 1, 3],
        [-1, 0, 0],
        [0.5, 0, 0],
    ),
    *(
        [None] * 3,
        ["x"] * 3,
        [[0], [1], [2]],
        np.array([0, 1, 9]),
        np.array([0.0, 1.0, np.nan]),
        True,
        Foreign(),
    ),
)
#: The plain arguments; the others are dataclasses and modules of ours.
OF_ENVIRONMENT = (
    "num_envs",
    "vehicles",
    "seed",
    "first_episode",
    "device",
    "dtype",
    "recycle",
)
OF_ENVIRONMENT += ("recycle_share", "kernel")
OF_TRAIN = (
    "traffic",
    "init",
    "total_decisions",
    "seed",
    "num_envs",
    "evaluation",
    "pretrain",
    "folder",
    "resume",
)
OF_TRAIN += (
    "env",
    "agent",
    "mask",
    "observation",
    "reward",
    "logger",
    "log_every",
    "evaluate_every",
    "device",
)
OF_EVALUATE = (
    "agents",
    "traffics",
    "episodes",
    "seed",
    "env",
    "reward",
    "observation",
    "mask",
    "num_envs",
    "stream",
)
OF_EVALUATE += ("device", "lanes", "goal_m")


def misuse(tally: Tally, seed: int, minutes: float) -> None:
    """All calls in random order, or as many as the minutes allow."""
    end = time.monotonic() + 60.0 * minutes
    calls = dict(_calls())
    names = list(calls)
    random.Random(seed).shuffle(names)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, result in forked(
            lambda name: _outcome(calls[name]), names, AT_MOST_S, memory_gib=16.0
        ):
            tally.what["calls"] += 1
            tally.what[result.split(maxsplit=1)[0].lower().rstrip(":")] += 1
            if not result.startswith(("REFUSED", "WORKED")):
                tally.fail(f"{name}: {result}")
            if time.monotonic() > end:
                return


def _outcome(call: Callable[[], Any]) -> str:
    """How a call ended, in words that begin with one in capitals."""
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            call()
    # gymnasium's own wrappers speak first in places.
    except (UserError, gymnasium.error.Error) as error:
        text = str(error)
        return f"TALKS in lines: {text[:300]!r}" if "\n" in text else f"REFUSED {text[:100]}"
    except OSError as error:  # the file system's own refusal, which the API passes on
        return (
            f"REFUSED {error}"[:100]
            if error.errno is not None
            else f"TRACEBACK {traceback_of(error)}"
        )
    except BaseException as error:
        # gymnasium and TensorDict look at some arguments before any of our code is asked.
        return f"{'TRACEBACK' if _through_ours(error) else 'REFUSED'} {traceback_of(error)}"
    return "WORKED"


def _through_ours(error: BaseException | None) -> bool:
    """Whether code of the package was at work when the error, or one that it came from, was raised."""
    while error is not None:
        if any(
            f"{PACKAGE}{os.sep}" in frame.filename
            for frame in traceback.extract_tb(error.__traceback__)
        ):
            return True
        error = error.__cause__ or error.__context__
    return False


def _calls() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Every call by its text."""
    traffic = IdmTraffic(Road(3))

    def environment(**given: Any) -> Any:
        return HighwayEnv(traffic, **given).rollout(2)

    def made(**given: Any) -> Any:
        return ganlane.make_env(**given).rollout(2)

    def train(**given: Any) -> Any:
        quick = {
            "total_decisions": 16,
            "num_envs": 4,
            "evaluation": {"episodes": 1},
            "traffic": "idm",
            **given,
        }
        # The checks, and what a command does around it: the training itself takes seconds.
        stopped = Mock(side_effect=UserError("stopped"))
        with patch.object(ganlane.commands.train, "train", stopped):
            return ganlane.api.train(**quick)

    def evaluate(**given: Any) -> Any:
        quick = {"agents": ["mobil"], "traffics": ["idm"], "episodes": 1, "goal_m": 20.0}
        return ganlane.api.evaluate(**{**quick, **given})

    def gym(**given: Any) -> Any:
        env = gymnasium.make("ganlane/Highway-v0", disable_env_checker=True, **given)
        env.reset(seed=0)
        return env.step(0)

    def batch(**given: Any) -> Any:
        envs = gymnasium.make_vec("ganlane/Highway-v0", **{"num_envs": 3, **given})
        envs.reset(seed=0)
        return envs.step(envs.action_space.sample())

    of_make_env = [
        name for name in inspect.signature(ganlane.make_env).parameters if name != "overrides"
    ]
    of_gym = [name for name in of_make_env if name not in ("num_envs", "device", "transforms")]
    yield from _each("HighwayEnv", environment, OF_ENVIRONMENT)
    yield from _each("make_env", made, [*of_make_env, "lanes", "vehicles", "idm", "recycle_share"])
    yield from _each("load_agent", ganlane.load_agent, ("name", "env", "stream", "device"))
    yield from _each("api.train", train, OF_TRAIN)
    yield from _each("api.evaluate", evaluate, OF_EVALUATE)
    yield from _each("api.run", ganlane.api.run, ("command",))
    yield from _each("gymnasium.make", gym, [*of_gym, "render_mode"])
    yield from _each("gymnasium.make_vec", batch, [*of_gym, "num_envs"])
    if SB3:
        yield from _each("sb3.make_vec_env", ganlane.sb3.make_vec_env, [*of_gym, "num_envs"])
    yield from _of_steps()


def _each(
    name: str, call: Callable[..., Any], arguments: list[str] | tuple[str, ...]
) -> Iterator[tuple[str, Callable[[], Any]]]:
    for argument in arguments:
        for value in VALUES:
            yield f"{name}({argument}={value!r:.60})", lambda a=argument, v=value: call(**{a: v})


def _of_steps() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Steps, resets and seeds at the wrong time or with the wrong things."""

    def step_env(action: Any) -> Any:
        env = ganlane.make_env("idm", 3)
        td = env.reset()
        td["action"] = torch.as_tensor(action) if isinstance(action, list | np.ndarray) else action
        return env.step(td)

    def step_batch(action: Any) -> Any:
        envs = gymnasium.make_vec("ganlane/Highway-v0", num_envs=3, traffic="idm")
        envs.reset()
        return envs.step(action)

    def step_gym(action: Any) -> Any:
        env = gymnasium.make("ganlane/Highway-v0", traffic="idm", disable_env_checker=True)
        env.reset()
        return env.step(action)

    for action in ACTIONS:
        # A TensorDict refuses what is no tensor before any of our code is asked.
        if isinstance(action, list | np.ndarray) and not any(
            each is None or each == "x" for each in list(action)
        ):
            yield f"env.step(action={action!r})", lambda a=action: step_env(a)
        yield f"make_vec(...).step({action!r})", lambda a=action: step_batch(a)
        yield f"make(...).step({action!r})", lambda a=action: step_gym(a)
    vec = "ganlane/Highway-v0"
    for value in VALUES:
        yield (
            f"make(...).reset(seed={value!r:.60})",
            lambda v=value: gymnasium.make(vec).reset(seed=v),
        )
        yield (
            f"make_vec(...).reset(seed={value!r:.60})",
            lambda v=value: gymnasium.make_vec(vec, num_envs=3).reset(seed=v),
        )
        yield (
            f"make(...).reset(options={value!r:.60})",
            lambda v=value: gymnasium.make(vec).reset(options=v),
        )
        yield (
            f"make(...).reset(options={{'episode': {value!r:.60}}})",
            lambda v=value: gymnasium.make(vec).reset(options={"episode": v}),
        )
    for number in (2**63, -(2**70), 1.5, "x"):
        yield f"env.set_seed({number})", lambda n=number: ganlane.make_env("idm", 2).set_seed(n)
    yield "env.step before reset", lambda: ganlane.make_env("idm", 2).rand_step()
    yield (
        "make_vec(...).step before reset",
        lambda: gymnasium.make_vec(vec, num_envs=2).step(np.zeros(2, np.int64)),
    )
    yield (
        "make(...).step before reset",
        lambda: gymnasium.make(vec, disable_env_checker=True).unwrapped.step(0),
    )
    yield (
        "make(...).render before reset",
        lambda: gymnasium.make(vec, render_mode="rgb_array").unwrapped.render(),
    )
    yield "default device meta", _on_meta


def _on_meta() -> Any:
    with torch.device("meta"):
        return ganlane.make_env("idm", 2).rollout(2)


def code(tally: Tally) -> None:
    """Run the tests in which every way to have code executed is tried once."""
    line = [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", TESTS]
    done = subprocess.run(
        line, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    counts = {
        kind: int(number)
        for number, kind in re.findall(r"(\d+) (passed|failed|error)", done.stdout)
    }
    tally.what["ways to have code executed"] = sum(counts.values())
    tally.what["that executed nothing"] = counts.get("passed", 0)
    for failed in re.findall(r"^(?:FAILED|ERROR) (.*)$", done.stdout, re.MULTILINE):
        tally.fail(failed)
    if not counts:
        tally.fail(f"{TESTS} did not run: {(done.stdout + done.stderr)[-300:]}")
