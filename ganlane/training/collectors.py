"""Collectors: each step is one decision of all environments, in order of time.

The training loop is the same for every :class:`Collector`. :class:`SingleCollector` steps the
environments in this process; with :class:`OverlapCollector` worker processes step them while the
loop updates. Runs with these two resume bit for bit. The collectors of
:mod:`ganlane.training.workers` wrap TorchRL's, in worker processes.
"""

from __future__ import annotations

import pickle
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
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
from ganlane.errors import UserError
from ganlane.transforms.sensors import PERCEIVED, SENSORS

#: Makes the environments of a worker from their number and first episode. It is pickled: a
#: module-level function or a ``functools.partial`` of one.
MakeEnv = Callable[[int, int], EnvBase]
#: Distance between the first episodes of two workers, so that no two ever drive the same episode.
EPISODES_PER_WORKER = 2**40
#: State of the simulation, most of a step's bytes, which the training loop does not need.
INNER = (keys.VEHICLES, keys.TRAFFIC, keys.ROAD, PERCEIVED, SENSORS)
#: Signals that end a run.
STOPPING = (signal.SIGINT, signal.SIGTERM)
#: Seconds for a worker to end by itself before it is killed.
_PATIENCE_S = 5.0
#: Seconds until a process whose pipe is closed has an exit code.
_NOTICED_S = 0.5


class Collector(ABC):
    """Steps of N environments, driven by the agent's exploring policy."""

    #: NAME in ``collector=NAME``, for messages.
    name: str
    #: N, over all processes.
    environments: int
    #: Whether a run resumes bit for bit.
    exact: bool
    #: Whether the loop makes its updates between :meth:`begin` and :meth:`step` rather than after
    #: both.
    overlaps: bool = False

    def open(self, agent: Rainbow) -> None:  # noqa: B027 (optional)
        """Start the workers, if there are any; without this call the first :meth:`step` starts
        them.

        Raises:
            UserError: they cannot be started.
        """

    def begin(self, agent: Rainbow) -> None:  # noqa: B027 (optional)
        """Start the next step with the agent's current weights and return without waiting for it."""

    @abstractmethod
    def step(self, agent: Rainbow) -> TensorDictBase:
        """One decision of every environment, batch [N], on the agent's device.

        Row i of a step continues row i of the last one; ``next`` is the outcome before any reset.
        """

    @abstractmethod
    def state_dict(self, exact: bool) -> dict[str, Any]:
        """Tensors and plain data to continue from.

        Bit for bit if ``exact``, else with the next episodes.
        """

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Continue from :meth:`state_dict` of environments of the same shape."""

    def close(self) -> None:  # noqa: B027 (optional)
        """Stop all workers, one that does not end by itself by force; may be called again."""

    def failure(self, error: Exception) -> str | None:
        """The reason, for the user, if ``error`` means that a worker was lost; else None."""
        return None

    @contextmanager
    def failures_as_user_errors(self) -> Iterator[None]:
        """Turn the loss of a worker into one sentence."""
        try:
            yield
        except Exception as error:
            reason = self.failure(error)
            if reason is None:
                raise
            raise UserError(
                f"collector={self.name}: {reason}; go on from the last checkpoint with resume."
            ) from error


class SingleCollector(Collector):
    """``collector=single``: steps ``env``, batch [N], in this process.

    ``env_state`` is the TensorDict with the environments' state. TorchRL's ``Collector`` does not
    expose it; here it is saved, so that a resumed run is exact.
    """

    name, exact = "single", True

    def __init__(self, env: EnvBase) -> None:
        self.env, self.environments = env, env.batch_size.numel()
        self.env_state: TensorDictBase = env.reset()

    def step(self, agent: Rainbow) -> TensorDictBase:
        """One decision; ended environments are reset in ``env_state``, not in the returned step."""
        decided = agent.policy(self.env_state)
        step, self.env_state = self.env.step_and_maybe_reset(decided)
        return step

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The state of the environments; unless ``exact``, only their episode numbers."""
        return pack(
            self.env_state
            if exact
            else self.env_state.select(keys.SEED, keys.EPISODE, strict=False)
        )

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Restore the state.

        Unless ``exact``, begin the episodes after those of ``state`` (or the first).
        """
        saved = unpack(state)
        if exact:
            self.env_state = saved
        elif keys.EPISODE in saved:
            self.env_state = self.env.reset(
                saved.set(keys.EPISODE, saved.get(keys.EPISODE) + self.environments)
            )
        else:
            self.env_state = self.env.reset()


def pack(tensordict: TensorDictBase) -> dict[str, Any]:
    """A TensorDict as plain data, with its (nested) batch sizes."""
    leaves = {
        key: pack(value) if isinstance(value, TensorDictBase) else value
        for key, value in tensordict.items()
    }
    return {"batch_size": list(tensordict.batch_size), "items": leaves}


def unpack(packed: dict[str, Any]) -> TensorDict:
    """The TensorDict of :func:`pack`."""
    items = {
        key: unpack(value) if isinstance(value, dict) else value
        for key, value in packed["items"].items()
    }
    return TensorDict(items, batch_size=packed["batch_size"])


class OverlapCollector(Collector):
    """``collector=overlap``: worker processes step the environments while this one learns, a
    barrier per step.

    :meth:`begin` chooses the actions of all environments with the current weights and sends them to
    the workers; the loop then makes the updates that are due, and :meth:`step` waits for the
    slowest worker. So the weights that choose an action lack the updates of one step, compared with
    ``collector=single``. The result does not depend on which side is faster, and nothing is in
    flight between two steps: runs are deterministic and resume bit for bit.

    The ``environments`` are shared out evenly: row ``w * rows + i`` of a step is row i of worker w,
    which starts with episode ``w * 2**40 + i``. A worker has one thread.
    """

    name, exact, overlaps = "overlap", True, True

    def __init__(self, make_env: MakeEnv, workers: int, environments: int) -> None:
        self.environments, self.rows = environments, environments // workers
        self._make = [
            partial(make_env, self.rows, worker * EPISODES_PER_WORKER) for worker in range(workers)
        ]
        self._processes: list[Any] = []
        self._pipes: list[Connection] = []
        #: Input of the policy for every environment, [N]; None: to be requested from the workers.
        self._seen: TensorDictBase | None = None
        #: The step in flight, and the shared memory in which the workers write its outcome.
        self._given: TensorDictBase | None = None
        self._results: list[TensorDictBase] = []

    def open(self, agent: Rainbow | None = None) -> None:
        """Start the workers, if they are not running."""
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
        """Send a request to all workers, with one argument of each list per worker.

        Return their answers.
        """
        self.open()
        with self.failures_as_user_errors():
            for worker, pipe in enumerate(self._pipes):
                send(pipe, (name, *(each[worker] for each in arguments)))
        return self._answers()

    def _answers(self) -> list[Any]:
        with self.failures_as_user_errors():
            answers = [pipe.recv() for pipe in self._pipes]
        for answer in answers:
            if isinstance(answer, UserError):
                raise answer
        return answers

    def begin(self, agent: Rainbow) -> None:
        """Choose the actions with the agent's current weights and send them to the workers."""
        if self._seen is None:
            self._seen = torch.cat(self._ask("look"))
        self._given = agent.policy(self._seen.to(agent.device))
        actions = self._given.get(keys.ACTION).cpu().split(self.rows)
        with self.failures_as_user_errors():
            for pipe, action in zip(self._pipes, actions):
                pipe.send(("step", action.numpy()))

    def step(self, agent: Rainbow) -> TensorDictBase:
        """The step started by :meth:`begin`, once all workers have made it."""
        if self._given is None:
            self.begin(agent)
        assert self._given is not None
        answers = self._answers()
        self._results = self._results or answers
        self._seen, after = (
            torch.cat([result.get(name) for result in self._results]) for name in ("seen", "after")
        )
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

    def failure(self, error: Exception) -> str | None:
        """A worker that ends closes its pipe."""
        if not isinstance(error, EOFError | OSError):
            return None
        for process in self._processes:
            process.join(_NOTICED_S)
        return why_lost(self._processes)

    def close(self) -> None:
        """Stop the workers."""
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

    The first answer to ``step`` is the TensorDict in shared memory to which later steps are
    written.
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
    """One decision: ``seen``, the policy's next input (reset after an ended episode).

    ``after``, before any reset.
    """
    given = source.env_state.set(keys.ACTION, torch.from_numpy(action))
    step, source.env_state = source.env.step_and_maybe_reset(given)
    after = step.get("next").exclude(*INNER)
    return TensorDict({"seen": visible(source.env_state), "after": after}, step.batch_size)


def visible(state: TensorDictBase) -> TensorDictBase:
    """``state`` without the memory of traffic and sensors, which policies do not read."""
    return state.exclude(*(name for name in INNER if name != keys.VEHICLES))


# --- worker processes


def exit_codes(processes: Sequence[Any]) -> dict[int, int]:
    """Exit codes of workers that failed or were killed, by worker."""
    codes: dict[int, int] = {}
    for worker, process in enumerate(processes):
        with suppress(ValueError):  # closed by TorchRL
            if process.exitcode:
                codes[worker] = process.exitcode
    return codes


def why_lost(processes: Sequence[Any]) -> str:
    """Why workers were lost, for an error message."""
    codes = exit_codes(processes)
    who = (
        ", ".join(f"worker {worker} (exit code {code})" for worker, code in codes.items())
        or "a worker"
    )
    if any(code > 0 for code in codes.values()):
        return f"{who} failed; its own message is above"
    return f"{who} died, killed from outside or for want of memory (fewer collector.workers or num_envs need less)"


@contextmanager
def shielded_children() -> Iterator[None]:
    """Context whose child processes never receive SIGINT and SIGTERM; signal handlers are restored
    at its end.

    A terminal sends Ctrl-C to all processes of a command, as Slurm and container runtimes do with
    SIGTERM: a worker would die in the middle of a step that the main process waits for. Children
    inherit the blocked signals; signals that arrive meanwhile are delivered to this process at the
    end. The handlers are restored because some libraries (``ray.init``) replace those of the
    training loop.
    """
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    can_block = hasattr(signal, "pthread_sigmask")
    if can_block:
        # Started by the first child, it would unblock the signals for all later children.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if signal.getsignal(number) != handler:
                signal.signal(number, handler)
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
