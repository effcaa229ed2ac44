"""``collector=multi`` and ``ray``: batches of several steps from TorchRL's workers, handed out one by one."""

from __future__ import annotations

import socket
import sys
import warnings
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
from ganlane.config.train import MultiCollectorConfig, RayCollectorConfig
from ganlane.errors import UserError
from ganlane.training.collectors import Collector, pack, unpack
from ganlane.training.signals import shielded_children
from ganlane.transforms.sensors import PERCEIVED, SENSORS

#: Makes the environments of a worker from their number and their first episode. It travels to the worker: a function
#: of a module, or a ``functools.partial`` of one.
MakeEnv = Callable[[int, int], EnvBase]
#: Functions that make the environments, or the policies, of one worker each.
Factories = Sequence[Callable[[], Any]]
#: A worker's first episodes are so far from the next one's that no two workers ever drive the same.
EPISODES_PER_WORKER = 2**40
#: State of the simulation, most of a step's bytes: the workers need it, the loop does not.
INNER = (keys.VEHICLES, keys.TRAFFIC, keys.ROAD, PERCEIVED, SENSORS)


class WorkerPolicy(ExploringPolicy):
    """The exploring policy of one worker: own noise and random actions, weights from outside."""

    def load(self, weights: Mapping[str, Tensor], epsilon: float) -> None:
        """Drive with ``weights`` (:meth:`Rainbow.weights`) and random share ``epsilon``."""
        load_parameters(self.network, weights)
        self.epsilon = epsilon


def make_policy(config: NetworkConfig, legal: LegalActions | None, seed: int) -> WorkerPolicy:
    """The policy of a worker, on its CPU; the first weights are still to come."""
    with torch.random.fork_rng(devices=[]):
        return WorkerPolicy(QNetwork(config), torch.Generator().manual_seed(seed), legal)


def noise_seed(seed: int, first_episode: int) -> int:
    """Seed of a worker's exploration: another one for every worker, and for every stretch of a resumed run."""
    return int(np.random.SeedSequence([seed, first_episode]).generate_state(1, np.uint64)[0] >> 1)


def read_by_loop(steps: TensorDictBase) -> TensorDictBase:
    """``steps`` without the state of the simulation."""
    return steps.exclude(*INNER, *(("next", name) for name in INNER))


class WorkerCollector(Collector):
    """Steps from TorchRL's collectors, on the CPUs of the workers.

    The workers take ``config.steps`` steps with the same weights, and wait while the learner works on them. They are
    started by :meth:`open`, at the latest by the first :meth:`step`. Row ``w * config.num_envs + i`` of a step is
    row i of worker w, which starts with episode ``w * 2**40 + i``.

    Args:
        make_env: makes the environments of one worker.
        config: how many, and how often they get new weights.
    """

    exact = False
    #: Of ``collector=NAME``, for messages.
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
        """A collector that makes these environments and policies; ``frames`` decisions of all workers at a time."""

    @abstractmethod
    def failure(self, error: Exception) -> str | None:
        """Why a worker was lost, in words for the user; None if ``error`` is about something else."""

    def open(self, agent: Rainbow) -> None:
        """Start the workers, if they are not at work; each has episodes and exploration of its own."""
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
        """The next step; where none is left, a new batch is collected with the agent's present weights."""
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
        """Weights and the share of random actions to every worker; all of them wait for it.

        Not by ``update_policy_weights_``: it sends what is in a module, the momentary noise too, and no epsilon.
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
        """The episodes that were under way at the end of the last batch."""
        return pack(self._last)

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Each worker begins after the last episode that it had begun; before the first :meth:`step` only."""
        last = unpack(state)
        self._last = last
        if keys.EPISODE in last:
            begun = last.get(keys.EPISODE).reshape(self.config.workers, -1).amax(1)
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


class ProcessCollector(WorkerCollector):
    """``collector=multi``: TorchRL's ``MultiSyncCollector``, processes that write their steps to shared memory."""

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
        """A dead worker shows as a closed pipe or as TorchRL's complaint."""
        processes = getattr(self.collector, "procs", ())
        closed = isinstance(error, EOFError | BrokenPipeError | ConnectionResetError)
        return why_lost(processes) if closed or exit_codes(processes) else None


def exit_codes(processes: Sequence[Any]) -> dict[int, int]:
    """Of the workers that failed or were killed, by their number."""
    codes: dict[int, int] = {}
    for worker, process in enumerate(processes):
        with suppress(ValueError):  # closed by TorchRL
            if process.exitcode:
                codes[worker] = process.exitcode
    return codes


def why_lost(processes: Sequence[Any]) -> str:
    """Of what the workers died, in words for the user."""
    codes = exit_codes(processes)
    who = ", ".join(f"worker {worker} (exit code {code})" for worker, code in codes.items()) or "a worker"
    if any(code > 0 for code in codes.values()):
        return f"{who} failed; its own message is above"
    return f"{who} died, killed from outside or for want of memory (fewer collector.workers or num_envs need less)"


class ClusterCollector(WorkerCollector):
    """``collector=ray``: TorchRL's ``RayCollector``, one actor per worker; only what the loop reads travels.

    Args:
        make_env: makes the environments of one worker; on a cluster, ganlane is installed on its machines.
        config: how many, and how often they get new weights; and the address of the cluster's head.

    Raises:
        UserError: Ray is not installed.
    """

    name = "ray"

    def __init__(self, make_env: MakeEnv, config: RayCollectorConfig) -> None:
        super().__init__(make_env, config)
        self.address = config.address
        try:
            import ray  # noqa: F401
        except ImportError as error:
            raise UserError("collector=ray: Ray is not installed; run pip install 'ganlane[ray]'.") from error

    def start(self, environments: Factories, policies: Factories, frames: int) -> BaseCollector:
        """An actor per worker; a Ray of our own has a CPU for each, however few the machine has."""
        from torchrl.collectors.distributed import RayCollector

        connection: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
        if self.address is None:
            connection |= {"address": "local", "num_cpus": self.config.workers, "include_dashboard": False}
        else:
            check_reachable(self.address)
            connection["address"] = self.address
        # A dictionary each: TorchRL writes the policy of a worker into its own.
        own = [{"postproc": read_by_loop, "auto_register_policy_transforms": False} for _ in environments]
        # TorchRL gets no weights to send, and warns of it twice: they are sent by _send_weights.
        warnings.filterwarnings("ignore", message="RayCollector iteration started before weight synchronization")
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
        """No cluster, an actor that is gone, or no Ray."""
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
        return  # auto, local, or something that Ray has a word for
    try:
        socket.create_connection((host.strip("[]"), int(port)), patience_s).close()
    except (OSError, OverflowError) as error:
        raise ConnectionError(str(error)) from error
