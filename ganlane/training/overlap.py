"""``collector=overlap``: processes drive the environments while this one learns, with a barrier at every step.

:meth:`OverlapCollector.begin` chooses the actions of all environments here, with the present weights, and sends them
to the workers; the loop then makes the updates that the steps before have paid for, and :meth:`OverlapCollector.step`
waits for the slowest worker. So the actions come from weights that lack the updates of one step, which
``collector=single`` would have made before. Nothing depends on which side is faster, and between two steps nothing is
under way: a run gives the same bits every time, and so does one that was stopped there and resumed.
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
from ganlane.env.native_step import threads_for
from ganlane.errors import UserError
from ganlane.training.collectors import Collector, SingleCollector, pack, unpack
from ganlane.training.signals import shielded_children
from ganlane.training.workers import EPISODES_PER_WORKER, INNER, MakeEnv, why_lost

#: Seconds that a worker has to end by itself.
_PATIENCE_S = 5.0
#: Seconds until the system has taken note of the end of a process whose pipe is closed.
_NOTICED_S = 0.5


class OverlapCollector(Collector):
    """Steps of environments that are shared out evenly between worker processes.

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
        #: What the policy sees of every environment, [N]; None: to be asked for.
        self._seen: TensorDictBase | None = None
        #: The step that is under way, and where the workers write what follows.
        self._given: TensorDictBase | None = None
        self._results: list[TensorDictBase] = []

    def open(self, agent: Rainbow) -> None:
        """Start the workers, if they are not at work."""
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
        theirs.close()  # so that the end of the worker is the end of the pipe
        self._processes.append(process)
        self._pipes.append(ours)

    def _ask(self, name: str, *arguments: list[Any]) -> list[Any]:
        """The workers' answers to a request, with an argument each of every list."""
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
        """Choose the actions with the agent's present weights and send the workers off."""
        self._start()
        if self._seen is None:
            self._seen = torch.cat(self._ask("look"))
        self._given = agent.policy(self._seen.to(agent.device))
        actions = self._given.get(keys.ACTION).cpu().split(self.rows)
        with self._failures_as_user_errors():
            for pipe, action in zip(self._pipes, actions):
                pipe.send(("step", action.numpy()))

    def step(self, agent: Rainbow) -> TensorDictBase:
        """The step that was begun (:meth:`begin`), as soon as all workers have made it."""
        if self._given is None:
            self.begin(agent)
        assert self._given is not None
        made = self._answers()
        self._results = made if not self._results else self._results
        self._seen, after = (torch.cat([result.get(name) for result in self._results]) for name in ("seen", "after"))
        step, self._given = self._given.set("next", after.to(agent.device)), None
        return step

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The state of all environments, in the form of :class:`SingleCollector`."""
        states = self._ask("state", [exact] * len(self._make))
        return pack(torch.cat([unpack(state) for state in states]))

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Every worker goes on from its rows of ``state``."""
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
        """End the workers; one that is busy or stuck is killed."""
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
                # A copy: what is seen and what follows are the same tensors where no episode ended.
                shared = answer.clone().share_memory_()
                pipe.send(shared)
            else:
                shared.update_(answer)
                pipe.send(None)


def send(pipe: Connection, message: Any) -> None:
    """Send by value: of a tensor in shared memory the receiver gets nothing once the sender is gone."""
    pipe.send_bytes(pickle.dumps(message))


def drive(source: SingleCollector, action: npt.NDArray[np.int64]) -> TensorDict:
    """One decision: what ``seen`` after it, with new episodes where one ended, and ``after`` it before any reset."""
    given = source.env_state.set(keys.ACTION, torch.from_numpy(action))
    with threads_for(source.env):
        step, source.env_state = source.env.step_and_maybe_reset(given)
    after = step.get("next").exclude(*INNER)
    return TensorDict({"seen": visible(source.env_state), "after": after}, step.batch_size)


def visible(state: TensorDictBase) -> TensorDictBase:
    """What a policy can read of ``state``: not the memory of the traffic and of the sensors."""
    return state.exclude(*(name for name in INNER if name != keys.VEHICLES))
