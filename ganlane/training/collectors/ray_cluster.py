"""``collector=ray``: workers on this machine or on those of a Ray cluster."""

from __future__ import annotations

import socket
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase

from ganlane.errors import UserError
from ganlane.training.collectors.remote import MakeEnv, read_by_loop
from ganlane.training.collectors.workers import Team, WorkerSource


class RaySource(WorkerSource):
    """TorchRL's ``RayCollector``: one actor with one CPU per worker; only what the loop reads travels.

    Args:
        make_env: makes the environments of one worker; on a cluster, ganlane is installed on its machines.
        team: how many, and how often they get new weights.
        address: of the cluster's head (``HOST:6379``, ``ray://HOST:10001`` or ``auto``); None: a Ray of its own, on
            this machine.

    Raises:
        UserError: Ray is not installed.
    """

    name = "ray"

    def __init__(self, make_env: MakeEnv, team: Team, address: str | None = None) -> None:
        super().__init__(make_env, team)
        self.address = address
        try:
            import ray  # noqa: F401
        except ImportError as error:
            raise UserError("collector=ray: Ray is not installed; run pip install 'ganlane[ray]'.") from error

    def start(
        self, environments: Sequence[Callable[[], EnvBase]], policies: Sequence[Callable[[], Any]], frames: int
    ) -> BaseCollector:
        """An actor per worker."""
        from torchrl.collectors.distributed import RayCollector

        if self.address is not None:
            knock(self.address)
        # A dictionary each: TorchRL writes the policy of a worker into its own.
        own = [{"postproc": read_by_loop, "auto_register_policy_transforms": False} for _ in environments]
        # TorchRL is told of no weights to send, and warns of it twice: the source hands them over itself.
        warnings.filterwarnings("ignore", message="RayCollector iteration started before weight synchronization")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return RayCollector(
                list(environments),
                policy_factory=list(policies),
                frames_per_batch=frames * self.team.workers,
                total_frames=sys.maxsize,  # its default, -1, is none at all
                sync=True,
                collector_kwargs=own,
                remote_configs={"num_cpus": 1, "num_gpus": 0},
                ray_init_config=self._connection(),
                trust_policy=True,
                weight_sync_schemes={},
            )

    def _connection(self) -> dict[str, Any]:
        """Arguments of ``ray.init``; a Ray of our own has a CPU for every worker, however few the machine has."""
        quiet = {"log_to_driver": False, "logging_level": "error"}
        if self.address is not None:
            return {"address": self.address, **quiet}
        return {"address": "local", "num_cpus": self.team.workers, "include_dashboard": False, **quiet}

    def arranged(self, batch: TensorDictBase) -> TensorDictBase:
        """TorchRL gives [workers, environments, steps]."""
        return batch.flatten(0, 1)

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


def knock(address: str, patience_s: float = 10.0) -> None:
    """See whether anybody listens at ``HOST:PORT`` or ``ray://HOST:PORT``; Ray itself asks for minutes.

    Raises:
        ConnectionError: nobody does.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not port.isdigit():
        return  # auto, local, or something that Ray has a word for
    try:
        socket.create_connection((host.strip("[]"), int(port)), patience_s).close()
    except (OSError, OverflowError) as error:
        raise ConnectionError(str(error)) from error
