"""``collector=overlap``: worker processes step the environments while this process learns, with a barrier per step.

:meth:`OverlapCollector.begin` chooses the actions of all environments with the current weights and sends them to the
workers; the loop then makes the updates that are due, and :meth:`OverlapCollector.step` waits for the slowest worker.
So the weights that choose an action lack the updates of one step, compared with ``collector=single``. The result does
not depend on which side is faster, and nothing is in flight between two steps: runs are deterministic and resume bit
for bit.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import multiprocessing
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import Rainbow
from ganlane.env.highway import threads_for
from ganlane.errors import UserError
from ganlane.training.collectors import Collector, SingleCollector, pack, unpack
from ganlane.training.signals import shielded_children
from ganlane.training.workers import EPISODES_PER_WORKER, INNER, MakeEnv, why_lost

#: Seconds for a worker to end by itself before it is killed.
_PATIENCE_S = 5.0
#: Seconds until a process whose pipe is closed has an exit code.
_NOTICED_S = 0.5


class OverlapCollector(Collector):
    """Steps environments that are divided evenly among worker processes.

    Row ``w * rows + i`` of a step is row i of worker w, which starts with episode ``w * 2**40 + i``.

    Args:
        make_env: makes the environments of one worker.
        workers: processes, with one thread each.
        environments: of all workers, a multiple of their number.
    """

    exact, overlaps = True, True

    def __init__(self, make_env: MakeEnv, workers: int, environments: int) -> None:
        self.environments, self.rows = environments, environments // workers
        firsts = [worker * EPISODES_PER_WORKER for worker in range(workers)]
        self._make = [partial(make_env, self.rows, first) for first in firsts]
        self._processes: list[Any] = []
        self._pipes: list[Connection] = []
        #: Input of the policy for every environment, [N]; None: to be requested from the workers.
        self._seen: TensorDictBase | None = None
        #: The step in flight, and the shared memory in which the workers write its outcome.
        self._given: TensorDictBase | None = None
        self._results: list[TensorDictBase] = []

    def open(self, agent: Rainbow) -> None:
        """Start the workers, if they are not running."""
        self._start()

    def _start(self) -> None:
        if not self._processes:
            with shielded_children():
                for make in self._make:
                    self._start_worker(make)

    def _start_worker(self, make: Callable[[], EnvBase]) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=work, args=(theirs, make), daemon=True)
        process.start()
        theirs.close()  # so that the pipe closes when the worker ends
        self._processes.append(process)
        self._pipes.append(ours)

    def _ask(self, name: str, *arguments: list[Any]) -> list[Any]:
        """Send a request to all workers, with one argument of each list per worker; return their answers."""
        self._start()
        with self._failures_as_user_errors():
            for worker, pipe in enumerate(self._pipes):
                send(pipe, (name, *(each[worker] for each in arguments)))
        return self._answers()

    def _answers(self) -> list[Any]:
        with self._failures_as_user_errors():
            answers = [pipe.recv() for pipe in self._pipes]
        for answer in answers:
            if isinstance(answer, UserError):
                raise answer
        return answers

    def begin(self, agent: Rainbow) -> None:
        """Choose the actions with the agent's current weights and send them to the workers."""
        self._start()
        if self._seen is None:
            self._seen = torch.cat(self._ask("look"))
        self._given = agent.policy(self._seen.to(agent.device))
        actions = self._given.get(keys.ACTION).cpu().split(self.rows)
        with self._failures_as_user_errors():
            for pipe, action in zip(self._pipes, actions):
                pipe.send(("step", action.numpy()))

    def step(self, agent: Rainbow) -> TensorDictBase:
        """The step started by :meth:`begin`, once all workers have made it."""
        if self._given is None:
            self.begin(agent)
        assert self._given is not None
        answers = self._answers()
        self._results = self._results or answers
        self._seen, after = (torch.cat([result.get(name) for result in self._results]) for name in ("seen", "after"))
        step, self._given = self._given.set("next", after.to(agent.device)), None
        return step

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The state of all environments, in the form of :class:`SingleCollector`."""
        states = self._ask("state", [exact] * len(self._make))
        return pack(torch.cat([unpack(state) for state in states]))

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Every worker continues from its rows of ``state``."""
        states = [pack(part) for part in unpack(state).split(self.rows)]
        self._ask("load", states, [exact] * len(states))
        self._seen = None

    @contextmanager
    def _failures_as_user_errors(self) -> Iterator[None]:
        """Turn the loss of a worker into one sentence."""
        try:
            yield
        except (EOFError, OSError) as error:
            for process in self._processes:
                process.join(_NOTICED_S)
            raise UserError(
                f"collector=overlap: {why_lost(self._processes)}; go on from the last checkpoint with resume."
            ) from error

    def close(self) -> None:
        """Stop the workers; one that does not end by itself is killed."""
        processes, self._processes = self._processes, []
        pipes, self._pipes = self._pipes, []
        for pipe in pipes:
            pipe.close()
        self._seen, self._given, self._results = None, None, []
        for process in processes:
            process.join(_PATIENCE_S)
            if process.is_alive():
                process.kill()
                process.join()


def work(pipe: Connection, make_env: Callable[[], EnvBase]) -> None:
    """A worker: answers requests until the other end of ``pipe`` is closed.

    The first answer to ``step`` is the TensorDict in shared memory to which later steps are written.
    """
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        source = SingleCollector(make_env())
        requests: dict[str, Callable[..., Any]] = {
            "step": partial(drive, source),
            "look": lambda: visible(source.env_state),
            "state": source.state_dict,
            "load": source.load_state_dict,
        }
        shared: TensorDictBase | None = None
        while True:
            name, *arguments = pipe.recv()
            try:
                answer = requests[name](*arguments)
            except UserError as error:
                answer = error
            if name != "step" or isinstance(answer, UserError):
                send(pipe, answer)
            elif shared is None:
                # A copy: ``seen`` and ``after`` share tensors if no episode ended.
                shared = answer.clone().share_memory_()
                pipe.send(shared)
            else:
                shared.update_(answer)
                pipe.send(None)


def send(pipe: Connection, message: Any) -> None:
    """Send by value: a tensor sent through shared memory would be lost if the sender ended first."""
    pipe.send_bytes(pickle.dumps(message))


def drive(source: SingleCollector, action: npt.NDArray[np.int64]) -> TensorDict:
    """One decision: ``seen``, the policy's next input (reset after an ended episode); ``after``, before any reset."""
    given = source.env_state.set(keys.ACTION, torch.from_numpy(action))
    with threads_for(source.env):
        step, source.env_state = source.env.step_and_maybe_reset(given)
    after = step.get("next").exclude(*INNER)
    return TensorDict({"seen": visible(source.env_state), "after": after}, step.batch_size)


def visible(state: TensorDictBase) -> TensorDictBase:
    """``state`` without the memory of traffic and sensors, which policies do not read."""
    return state.exclude(*(name for name in INNER if name != keys.VEHICLES))
