"""``collector=ray``: TorchRL's ``RayCollector``, actors on this machine or a cluster; needs the extra ``ray``."""

from __future__ import annotations

import sys
import warnings
from typing import Any

import ray
from ray.exceptions import RayActorError
from torchrl.collectors import BaseCollector
from torchrl.collectors.distributed import RayCollector

from ganlane.config.train import RayCollectorConfig
from ganlane.training.workers import Factories, MakeEnv, WorkerCollector, check_reachable, read_by_loop


class ClusterCollector(WorkerCollector):
    """``collector=ray``: TorchRL's ``RayCollector``, one actor per worker; the state of the simulation is not sent.

    Args:
        make_env: makes the environments of one worker; on a cluster, ganlane must be installed on its machines.
        config: number of workers and environments, steps between new weights, and the address of the cluster's head.
    """

    name = "ray"

    def __init__(self, make_env: MakeEnv, config: RayCollectorConfig) -> None:
        super().__init__(make_env, config)
        self.address = config.address

    def start(self, environments: Factories, policies: Factories, frames: int) -> BaseCollector:
        """One actor per worker; a local Ray gets one CPU per worker, even on a smaller machine."""
        connection: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
        if self.address is None:
            connection |= {"address": "local", "num_cpus": self.config.workers, "include_dashboard": False}
        else:
            check_reachable(self.address)
            connection["address"] = self.address
        # One dictionary per worker: TorchRL writes the worker's policy into it.
        own = [{"postproc": read_by_loop, "auto_register_policy_transforms": False} for _ in environments]
        # TorchRL warns twice that it has no weights to send; :meth:`_send_weights` sends them.
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
        """No cluster answers, an actor is gone, or Ray did not start."""
        if isinstance(error, ConnectionError):
            return f"no Ray cluster answers at collector.address={self.address}, start one or leave the address out"
        if isinstance(error, RayActorError):
            return "a worker died or its machine was lost"
        if not ray.is_initialized():
            return f"Ray could not be started ({str(error).partition('.')[0]}), see whether the machine is overloaded"
        return None
