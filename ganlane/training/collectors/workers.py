"""What ``collector=multi`` and ``ray`` share: batches of several steps from workers, handed out one by one."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import Rainbow
from ganlane.errors import UserError
from ganlane.training.checkpoints import pack, unpack
from ganlane.training.collectors.remote import EPISODES_PER_WORKER, MakeEnv, make_policy, noise_seed, read_by_loop
from ganlane.training.collectors.signals import shielded_children
from ganlane.training.collectors.source import Source


@dataclass(frozen=True)
class Team:
    """Who collects: ``workers``, each with ``environments`` of its own.

    ``weights_every`` is the number of decisions, over all environments, that are collected with the same weights;
    rounded down to whole steps, at least one.
    """

    workers: int
    environments: int
    weights_every: int

    @property
    def rows(self) -> int:
        """Environments of all workers."""
        return self.workers * self.environments

    @property
    def steps(self) -> int:
        """Steps that a worker takes with the same weights."""
        return max(1, self.weights_every // self.rows)


class WorkerSource(Source):
    """Steps from TorchRL's collectors, on the CPUs of the workers.

    The workers take ``team.steps`` steps with the same weights, and wait while the learner works on them. They are
    started by :meth:`open`, at the latest by the first :meth:`step`. Row ``w * team.environments + i`` of a step is
    row i of worker w, which starts with episode ``w * 2**40 + i``.

    Args:
        make_env: makes the environments of one worker.
        team: how many, and how often they get new weights.
    """

    exact = False
    #: Of ``collector=NAME``, for messages.
    name: str

    def __init__(self, make_env: MakeEnv, team: Team) -> None:
        self.make_env, self.team, self.environments = make_env, team, team.rows
        self.first_episodes = [worker * EPISODES_PER_WORKER for worker in range(team.workers)]
        self.collector: BaseCollector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._steps: deque[TensorDictBase] = deque()
        self._last: TensorDictBase = TensorDict({}, [self.environments])

    @abstractmethod
    def start(
        self, environments: Sequence[Callable[[], EnvBase]], policies: Sequence[Callable[[], Any]], frames: int
    ) -> BaseCollector:
        """A collector that makes these environments and policies; ``frames`` decisions of each worker at a time."""

    @abstractmethod
    def arranged(self, batch: TensorDictBase) -> TensorDictBase:
        """A batch of the collector as [rows, steps]."""

    @abstractmethod
    def failure(self, error: Exception) -> str | None:
        """What to tell the user where ``error`` means that a worker is lost; None for any other error."""

    def step(self, agent: Rainbow) -> TensorDictBase:
        """The next step; where none is left, a new batch is collected with the agent's present weights."""
        if not self._steps:
            self._collect(agent)
        return self._steps.popleft()

    def open(self, agent: Rainbow) -> None:
        """Start the workers, if they are not at work."""
        if self.collector is None:
            with self._told():
                self._start(agent)

    @contextmanager
    def _told(self) -> Iterator[None]:
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

    def _collect(self, agent: Rainbow) -> None:
        self.open(agent)
        with self._told():
            self._hand_over(agent)
            batch = read_by_loop(self.arranged(next(self._batches)))
        self._last = batch[:, -1].get("next").select(keys.SEED, keys.EPISODE, strict=False)
        self._steps.extend(batch.to(agent.device).unbind(1))

    def _start(self, agent: Rainbow) -> None:
        """Start the workers; each has episodes and exploration of its own."""
        seed, config, legal = agent.generators["collect"].initial_seed(), agent.network.config, agent.policy.legal
        environments = [partial(self.make_env, self.team.environments, first) for first in self.first_episodes]
        policies = [partial(make_policy, config, legal, noise_seed(seed, first)) for first in self.first_episodes]
        threads = torch.get_num_threads()
        with shielded_children():
            self.collector = self.start(environments, policies, self.team.environments * self.team.steps)
        torch.set_num_threads(threads)
        self._batches = iter(self.collector)

    def _hand_over(self, agent: Rainbow) -> None:
        """Weights and the share of random actions to every worker; all of them wait for it.

        Not by ``update_policy_weights_``: it sends what is in a module, the momentary noise too, and no epsilon.
        """
        assert self.collector is not None
        weights = {name: value.cpu() for name, value in agent.weights().items()}
        self.collector.map_fn("policy.load", [(weights, agent.policy.epsilon)] * self.team.workers)

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The episodes that were under way at the end of the last batch."""
        return pack(self._last)

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Each worker begins after the last episode that it had begun; before the first :meth:`step` only."""
        last = unpack(state)
        if last.batch_size != (self.environments,):
            raise ValueError(str(list(last.batch_size)))
        self._last = last
        if keys.EPISODE in last:
            begun = last.get(keys.EPISODE).reshape(self.team.workers, -1).amax(1)
            self.first_episodes = [int(episode) + 1 for episode in begun.tolist()]

    def close(self) -> None:
        """End the workers; one that does not end by itself is killed."""
        collector, self.collector = self.collector, None
        self._steps.clear()
        self._batches = iter(())
        if collector is not None:
            threads = torch.get_num_threads()
            with suppress(Exception):  # a worker that is gone already is no reason to leave the others
                collector.shutdown()
            torch.set_num_threads(threads)
