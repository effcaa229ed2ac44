"""``collector=ray``: environments on this machine or on a cluster, by TorchRL's RayCollector.

Workers make some steps with the same weights, then wait for the learner; here their batch is given
back step by step. The state of the simulation stays with them, so a resumed run is not bit-exact.
"""

from __future__ import annotations

import signal
import socket
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import NetworkConfig, QNetwork, Rainbow
from ganlane.agents.drivers import ExploringPolicy, LegalActions
from ganlane.agents.network import load_parameters
from ganlane.config.train import RayCollectorConfig
from ganlane.errors import UserError
from ganlane.training.collectors import Collector, pack, unpack
from ganlane.transforms.observation import PERCEIVED, SENSORS

#: Distance between the first episodes of two workers, so that no two ever drive the same episode.
EPISODES_PER_WORKER = 2**40
#: State of the simulation, most of a step's bytes, which the training loop does not need.
INNER = (keys.VEHICLES, keys.TRAFFIC, keys.ROAD, PERCEIVED, SENSORS)
#: Signals that end a run; children of a run must not see them.
STOPPING = (signal.SIGINT, signal.SIGTERM)


class WorkerPolicy(ExploringPolicy):
    """The exploring policy of a worker, with its own random numbers."""

    def load(self, weights: Mapping[str, Tensor], epsilon: float) -> None:
        """Use the learner's ``weights`` and its share ``epsilon`` of random actions."""
        load_parameters(self.network, weights)
        self.epsilon = epsilon


def make_policy(
    network: NetworkConfig, legal: LegalActions | None, seed: int, first_episode: int
) -> WorkerPolicy:
    """The policy of a worker; its noise differs by worker and every time a run is resumed."""
    (own_seed,) = np.random.SeedSequence([seed, first_episode]).generate_state(1, np.uint64)
    with torch.random.fork_rng(devices=[]):
        generator = torch.Generator().manual_seed(int(own_seed >> np.uint64(1)))
        return WorkerPolicy(QNetwork(network), generator, legal)


def read_by_loop(steps: TensorDictBase) -> TensorDictBase:
    """``steps`` without the state of the simulation."""
    return steps.exclude(*INNER, *(("next", name) for name in INNER))


class ClusterCollector(Collector):
    """Row ``w * config.num_envs + i`` of a step is row i of worker w.

    It starts with episode ``w * 2**40 + i``. ``make_env`` makes a worker's environments from their
    number and first episode; it is pickled. On a cluster, ganlane must be installed everywhere.

    Raises:
        UserError: Ray is not installed (extra ``ray``).
    """

    exact = False

    def __init__(self, make_env: Callable[[int, int], EnvBase], config: RayCollectorConfig) -> None:
        try:
            import ray  # noqa: F401
        except ModuleNotFoundError as error:
            raise UserError(
                "collector=ray: Ray is not installed; run pip install 'ganlane[ray]'."
            ) from error
        self.make_env, self.config, self.environments = make_env, config, config.environments
        self.first_episodes = [worker * EPISODES_PER_WORKER for worker in range(config.workers)]
        self.workers: Any = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._steps: deque[TensorDictBase] = deque()
        self._last: TensorDictBase = TensorDict({}, [self.environments])

    def open(self, agent: Rainbow) -> None:
        """Start the workers, if they are not running."""
        if self.workers is not None:
            return
        seed = agent.generators["collect"].initial_seed()
        environments, policies = [], []
        for first in self.first_episodes:
            environments.append(partial(self.make_env, self.config.num_envs, first))
            network, legal = agent.network.config, agent.policy.legal
            policies.append(partial(make_policy, network, legal, seed, first))
        with self._losses_as_user_errors(), shielded_children():
            self.workers = self.start(environments, policies)
        self._batches = iter(self.workers)

    def start(self, environments: list[Any], policies: list[Any]) -> Any:
        """TorchRL's collector, one actor per worker."""
        from torchrl.collectors.distributed import RayCollector

        connection: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
        if self.config.address is None:  # one CPU per worker, even on a smaller machine
            connection |= {"address": "local", "num_cpus": self.config.workers}
            connection["include_dashboard"] = False
        else:
            check_reachable(self.config.address)
            connection["address"] = self.config.address
        options = {"postproc": read_by_loop, "auto_register_policy_transforms": False}
        # it warns that it has no weights to send; step sends them
        warnings.filterwarnings("ignore", message="RayCollector iteration started before weight")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return RayCollector(
                environments,
                policy_factory=policies,
                frames_per_batch=self.environments * self.config.steps,
                total_frames=sys.maxsize,  # its default, -1, is none at all
                sync=True,
                # a dictionary per worker: TorchRL writes the worker's policy into it
                collector_kwargs=[dict(options) for _ in environments],
                remote_configs={"num_cpus": 1, "num_gpus": 0},
                ray_init_config=connection,
                trust_policy=True,
                weight_sync_schemes={},
            )

    def step(self, agent: Rainbow) -> TensorDictBase:
        """The next step; after the last of a batch, collect another with the current weights."""
        if not self._steps:
            self.open(agent)
            with self._losses_as_user_errors():
                # update_policy_weights_ would send the present noise too, and no epsilon
                weights = {name: value.cpu() for name, value in agent.weights().items()}
                arguments = [(weights, agent.policy.epsilon)] * self.config.workers
                self.workers.map_fn("policy.load", arguments)
                # [workers, environments, steps]
                batch = read_by_loop(next(self._batches)).flatten(0, 1)
            self._last = batch[:, -1].get("next").select(keys.SEED, keys.EPISODE, strict=False)
            self._steps.extend(batch.to(agent.device).unbind(1))
        return self._steps.popleft()

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The episode numbers at the end of the last batch."""
        return pack(self._last)

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Each worker begins after the last episode that it had begun."""
        self._last = unpack(state)
        if keys.EPISODE in self._last:
            begun = self._last.get(keys.EPISODE).reshape(self.config.workers, -1).amax(1)
            self.first_episodes = [int(episode) + 1 for episode in begun.tolist()]

    def close(self) -> None:
        """Stop the workers."""
        workers, self.workers = self.workers, None
        self._steps.clear()
        if workers is not None:
            with suppress(Exception):  # stop the other workers even if one is gone
                workers.shutdown()

    @contextmanager
    def _losses_as_user_errors(self) -> Iterator[None]:
        """Turn the loss of a worker, or of Ray, into one sentence."""
        import ray
        from ray.exceptions import RayActorError

        address = self.config.address
        try:
            yield
        except Exception as error:
            if isinstance(error, ConnectionError):
                reason = f"no Ray cluster answers at collector.address={address}, start one or "
                reason += "leave the address out"
            elif isinstance(error, RayActorError):
                reason = "a worker died or its machine was lost"
            elif not ray.is_initialized():
                reason = f"Ray could not be started ({str(error).partition('.')[0]}), see whether "
                reason += "the machine is overloaded"
            else:
                raise
            raise UserError(
                f"collector=ray: {reason}; go on from the last checkpoint with resume."
            ) from error


@contextmanager
def shielded_children() -> Iterator[None]:
    """Context whose child processes never receive SIGINT and SIGTERM.

    A terminal sends Ctrl-C to all processes of a command: a worker would die in the middle of a
    step that the main process waits for. Children inherit the blocked signals; those that arrive
    meanwhile are delivered to this process at the end. Handlers, which ``ray.init`` replaces, are
    put back.
    """
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if signal.getsignal(number) != handler:
                signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


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
