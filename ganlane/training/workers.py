"""``collector=multi``: TorchRL's collectors in worker processes; batches are returned step by step."""

from __future__ import annotations

import socket
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import Rainbow
from ganlane.agents.network import NetworkConfig, QNetwork, load_parameters
from ganlane.agents.policy import ExploringPolicy, LegalActions
from ganlane.config.train import MultiCollectorConfig
from ganlane.errors import UserError
from ganlane.training.collectors import Collector, pack, unpack
from ganlane.training.signals import shielded_children
from ganlane.transforms.observation import PERCEIVED, SENSORS

#: Makes the environments of a worker from their number and first episode. It is pickled: a module-level function or
#: a ``functools.partial`` of one.
MakeEnv = Callable[[int, int], EnvBase]
#: Per worker, a function that makes its environments or its policy.
Factories = Sequence[Callable[[], Any]]
#: Distance between the first episodes of two workers, so that no two ever drive the same episode.
EPISODES_PER_WORKER = 2**40
#: State of the simulation, most of a step's bytes, which the training loop does not need.
INNER = (keys.VEHICLES, keys.TRAFFIC, keys.ROAD, PERCEIVED, SENSORS)


class WorkerPolicy(ExploringPolicy):
    """The exploring policy of a worker, with its own random numbers; the learner sends the weights."""

    def load(self, weights: Mapping[str, Tensor], epsilon: float) -> None:
        """Use ``weights`` (:meth:`Rainbow.weights`) and the share ``epsilon`` of random actions."""
        load_parameters(self.network, weights)
        self.epsilon = epsilon


def make_policy(config: NetworkConfig, legal: LegalActions | None, seed: int) -> WorkerPolicy:
    """The policy of a worker, on its CPU, before it receives its first weights."""
    with torch.random.fork_rng(devices=[]):
        return WorkerPolicy(QNetwork(config), torch.Generator().manual_seed(seed), legal)


def noise_seed(seed: int, first_episode: int) -> int:
    """Seed of a worker's exploration, different for every worker and every time a run is resumed."""
    return int(np.random.SeedSequence([seed, first_episode]).generate_state(1, np.uint64)[0] >> 1)


def read_by_loop(steps: TensorDictBase) -> TensorDictBase:
    """``steps`` without the state of the simulation."""
    return steps.exclude(*INNER, *(("next", name) for name in INNER))


class WorkerCollector(Collector):
    """Steps from TorchRL's collectors, on the CPUs of the workers.

    The workers make ``config.steps`` steps with the same weights, then wait for the learner. They are started by
    :meth:`open` or the first :meth:`step`. Row ``w * config.num_envs + i`` of a step is row i of worker w, which
    starts with episode ``w * 2**40 + i``.

    Args:
        make_env: makes the environments of one worker.
        config: number of workers and environments, and steps between new weights.
    """

    exact = False
    #: NAME in ``collector=NAME``, for messages.
    name: str

    def __init__(self, make_env: MakeEnv, config: MultiCollectorConfig) -> None:
        self.make_env, self.config, self.environments = make_env, config, config.environments
        self.first_episodes = [worker * EPISODES_PER_WORKER for worker in range(config.workers)]
        self.collector: BaseCollector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._steps: deque[TensorDictBase] = deque()
        self._last: TensorDictBase = TensorDict({}, [self.environments])

    @abstractmethod
    def start(self, environments: Factories, policies: Factories, frames: int) -> BaseCollector:
        """TorchRL's collector of these environments and policies, ``frames`` decisions of all workers per batch."""

    @abstractmethod
    def failure(self, error: Exception) -> str | None:
        """The reason, for the user, if ``error`` means that a worker was lost; else None."""

    def open(self, agent: Rainbow) -> None:
        """Start the workers, if they are not running; each has its own episodes and exploration."""
        if self.collector is not None:
            return
        seed, config, legal = agent.generators["collect"].initial_seed(), agent.network.config, agent.policy.legal
        environments = [partial(self.make_env, self.config.num_envs, first) for first in self.first_episodes]
        policies = [partial(make_policy, config, legal, noise_seed(seed, first)) for first in self.first_episodes]
        threads = torch.get_num_threads()
        with self._failures_as_user_errors(), shielded_children():
            self.collector = self.start(environments, policies, self.environments * self.config.steps)
        torch.set_num_threads(threads)
        self._batches = iter(self.collector)

    def step(self, agent: Rainbow) -> TensorDictBase:
        """The next step of the batch; after the last one, collect a new batch with the agent's current weights."""
        if not self._steps:
            self.open(agent)
            with self._failures_as_user_errors():
                self._send_weights(agent)
                batch = read_by_loop(next(self._batches))
            # [workers * environments, steps]; from Ray [workers, environments, steps].
            batch = batch.flatten(0, 1) if batch.dim() == 3 else batch
            self._last = batch[:, -1].get("next").select(keys.SEED, keys.EPISODE, strict=False)
            self._steps.extend(batch.to(agent.device).unbind(1))
        return self._steps.popleft()

    def _send_weights(self, agent: Rainbow) -> None:
        """Send weights and epsilon to every worker; all wait for it.

        TorchRL's ``update_policy_weights_`` would send the current noise of the noisy layers too, and no epsilon.
        """
        assert self.collector is not None
        weights = {name: value.cpu() for name, value in agent.weights().items()}
        self.collector.map_fn("policy.load", [(weights, agent.policy.epsilon)] * self.config.workers)

    @contextmanager
    def _failures_as_user_errors(self) -> Iterator[None]:
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

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The episode numbers at the end of the last batch."""
        return pack(self._last)

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Each worker begins after the last episode that it had begun; call before the first :meth:`step` only."""
        last = unpack(state)
        self._last = last
        if keys.EPISODE in last:
            begun = last.get(keys.EPISODE).reshape(self.config.workers, -1).amax(1)
            self.first_episodes = [int(episode) + 1 for episode in begun.tolist()]

    def close(self) -> None:
        """Stop the workers; one that does not end by itself is killed."""
        collector, self.collector = self.collector, None
        self._steps.clear()
        self._batches = iter(())
        if collector is not None:
            threads = torch.get_num_threads()
            with suppress(Exception):  # stop the other workers even if one is gone
                collector.shutdown()
            torch.set_num_threads(threads)


class ProcessCollector(WorkerCollector):
    """``collector=multi``: TorchRL's ``MultiSyncCollector``, processes with shared memory."""

    name = "multi"

    def start(self, environments: Factories, policies: Factories, frames: int) -> BaseCollector:
        """One process per worker, with one thread each."""
        return MultiSyncCollector(
            list(environments),
            policy_factory=list(policies),
            frames_per_batch=frames,
            cat_results=0,
            use_buffers=True,
            trust_policy=True,
            num_threads=torch.get_num_threads(),
            num_sub_threads=1,
            auto_register_policy_transforms=False,
        )

    def failure(self, error: Exception) -> str | None:
        """A dead worker closes its pipe, or makes TorchRL raise an error."""
        processes = getattr(self.collector, "procs", ())
        closed = isinstance(error, EOFError | BrokenPipeError | ConnectionResetError)
        return why_lost(processes) if closed or exit_codes(processes) else None


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
    who = ", ".join(f"worker {worker} (exit code {code})" for worker, code in codes.items()) or "a worker"
    if any(code > 0 for code in codes.values()):
        return f"{who} failed; its own message is above"
    return f"{who} died, killed from outside or for want of memory (fewer collector.workers or num_envs need less)"


def check_reachable(address: str, patience_s: float = 10.0) -> None:
    """Try to connect to ``HOST:PORT`` or ``ray://HOST:PORT``; Ray itself would try for minutes.

    Raises:
        ConnectionError: no process listens there.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not port.isdigit():
        return  # auto, local, or another form that Ray checks itself
    try:
        socket.create_connection((host.strip("[]"), int(port)), patience_s).close()
    except (OSError, OverflowError) as error:
        raise ConnectionError(str(error)) from error
