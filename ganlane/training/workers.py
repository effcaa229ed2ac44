"""``collector=multi`` and ``collector=ray``: TorchRL's collectors.

Their batches are returned step by step.
"""

from __future__ import annotations

import socket
import sys
import warnings
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector, MultiSyncCollector

from ganlane import keys
from ganlane.agents import NetworkConfig, QNetwork, Rainbow
from ganlane.agents.drivers import ExploringPolicy, LegalActions
from ganlane.agents.network import load_parameters
from ganlane.settings.train import MultiCollectorConfig, RayCollectorConfig
from ganlane.errors import UserError
from ganlane.training.collectors import (
    EPISODES_PER_WORKER,
    INNER,
    Collector,
    MakeEnv,
    exit_codes,
    pack,
    shielded_children,
    unpack,
    why_lost,
)

#: Per worker, a function that makes its environments or its policy.
Factories = Sequence[Callable[[], Any]]


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

    The workers make ``config.steps`` steps with the same weights, then wait for the learner. They
    are started by :meth:`open` or the first :meth:`step`. Row ``w * config.num_envs + i`` of a step
    is row i of worker w, which starts with episode ``w * 2**40 + i``.
    """

    exact = False

    def __init__(self, make_env: MakeEnv, config: MultiCollectorConfig) -> None:
        self.make_env, self.config, self.environments = make_env, config, config.environments
        self.first_episodes = [worker * EPISODES_PER_WORKER for worker in range(config.workers)]
        self.collector: BaseCollector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._steps: deque[TensorDictBase] = deque()
        self._last: TensorDictBase = TensorDict({}, [self.environments])

    @abstractmethod
    def start(self, environments: Factories, policies: Factories, frames: int) -> BaseCollector:
        """TorchRL's collector of these environments and policies, ``frames`` decisions of all
        workers per batch.
        """

    def open(self, agent: Rainbow) -> None:
        """Start the workers, if they are not running; each has its own episodes and exploration."""
        if self.collector is not None:
            return
        seed, config, legal = (
            agent.generators["collect"].initial_seed(),
            agent.network.config,
            agent.policy.legal,
        )
        environments = [
            partial(self.make_env, self.config.num_envs, first) for first in self.first_episodes
        ]
        policies = [
            partial(make_policy, config, legal, noise_seed(seed, first))
            for first in self.first_episodes
        ]
        threads = torch.get_num_threads()
        with self.failures_as_user_errors(), shielded_children():
            self.collector = self.start(
                environments, policies, self.environments * self.config.steps
            )
        torch.set_num_threads(threads)
        self._batches = iter(self.collector)

    def step(self, agent: Rainbow) -> TensorDictBase:
        """The next step of the batch.

        After the last one, collect a new batch with the agent's current weights.
        """
        if not self._steps:
            self.open(agent)
            with self.failures_as_user_errors():
                self._send_weights(agent)
                batch = read_by_loop(next(self._batches))
            # [workers * environments, steps]; from Ray [workers, environments, steps].
            batch = batch.flatten(0, 1) if batch.dim() == 3 else batch
            self._last = batch[:, -1].get("next").select(keys.SEED, keys.EPISODE, strict=False)
            self._steps.extend(batch.to(agent.device).unbind(1))
        return self._steps.popleft()

    def _send_weights(self, agent: Rainbow) -> None:
        """Send weights and epsilon to every worker; all wait for it.

        TorchRL's ``update_policy_weights_`` would send the current noise of the noisy layers too,
        and no epsilon.
        """
        assert self.collector is not None
        weights = {name: value.cpu() for name, value in agent.weights().items()}
        self.collector.map_fn(
            "policy.load", [(weights, agent.policy.epsilon)] * self.config.workers
        )

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The episode numbers at the end of the last batch."""
        return pack(self._last)

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Each worker begins after the last episode that it had begun.

        Call before the first :meth:`step` only.
        """
        self._last = unpack(state)
        if keys.EPISODE in self._last:
            begun = self._last.get(keys.EPISODE).reshape(self.config.workers, -1).amax(1)
            self.first_episodes = [int(episode) + 1 for episode in begun.tolist()]

    def close(self) -> None:
        """Stop the workers."""
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


class ClusterCollector(WorkerCollector):
    """``collector=ray``: TorchRL's ``RayCollector``, one actor per worker, on this machine or a
    cluster.

    The state of the simulation is not sent. On a cluster, ganlane must be installed on its
    machines.

    Raises:
        UserError: Ray is not installed (extra ``ray``).
    """

    name = "ray"

    def __init__(self, make_env: MakeEnv, config: RayCollectorConfig) -> None:
        try:
            import ray  # noqa: F401
        except ModuleNotFoundError as error:
            raise UserError(
                "collector=ray: Ray is not installed; run pip install 'ganlane[ray]'."
            ) from error
        super().__init__(make_env, config)
        self.address = config.address

    def start(self, environments: Factories, policies: Factories, frames: int) -> BaseCollector:
        """One actor per worker; a local Ray gets one CPU per worker, even on a smaller machine."""
        from torchrl.collectors.distributed import RayCollector

        connection: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
        if self.address is None:
            connection |= {
                "address": "local",
                "num_cpus": self.config.workers,
                "include_dashboard": False,
            }
        else:
            check_reachable(self.address)
            connection["address"] = self.address
        # One dictionary per worker: TorchRL writes the worker's policy into it.
        own = [
            {"postproc": read_by_loop, "auto_register_policy_transforms": False}
            for _ in environments
        ]
        # TorchRL warns twice that it has no weights to send; :meth:`_send_weights` sends them.
        warnings.filterwarnings(
            "ignore", message="RayCollector iteration started before weight synchronization"
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return RayCollector(
                list(environments),
                policy_factory=list(policies),
                frames_per_batch=frames,
                total_frames=sys.maxsize,  # its default, -1, is none at all
                sync=True,
                collector_kwargs=own,
                remote_configs={"num_cpus": 1, "num_gpus": 0},
                ray_init_config=connection,
                trust_policy=True,
                weight_sync_schemes={},
            )

    def failure(self, error: Exception) -> str | None:
        """No cluster answers, an actor is gone, or Ray did not start."""
        import ray
        from ray.exceptions import RayActorError

        if isinstance(error, ConnectionError):
            return f"no Ray cluster answers at collector.address={self.address}, start one or leave the address out"
        if isinstance(error, RayActorError):
            return "a worker died or its machine was lost"
        if not ray.is_initialized():
            return f"Ray could not be started ({str(error).partition('.')[0]}), see whether the machine is overloaded"
        return None


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
