"""``collector=multi``: worker processes on this machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.envs import EnvBase

from ganlane.training.collectors.workers import WorkerSource


class MultiSource(WorkerSource):
    """TorchRL's ``MultiSyncCollector``: processes that are spawned, and write their steps to shared memory."""

    name = "multi"

    def start(
        self, environments: Sequence[Callable[[], EnvBase]], policies: Sequence[Callable[[], Any]], frames: int
    ) -> BaseCollector:
        """One process per worker, with one thread each."""
        return MultiSyncCollector(
            list(environments),
            policy_factory=list(policies),
            frames_per_batch=frames * self.team.workers,
            cat_results=0,
            use_buffers=True,
            trust_policy=True,
            num_threads=torch.get_num_threads(),
            num_sub_threads=1,
            auto_register_policy_transforms=False,
        )

    def arranged(self, batch: TensorDictBase) -> TensorDictBase:
        """Already concatenated by TorchRL."""
        return batch

    def failure(self, error: Exception) -> str | None:
        """A dead worker shows as a closed pipe or as TorchRL's complaint; its exit code tells of what it died."""
        codes = {worker: code for worker, code in enumerate(self._exit_codes()) if code not in (None, 0)}
        if not codes and not isinstance(error, EOFError | BrokenPipeError | ConnectionResetError):
            return None
        who = ", ".join(f"worker {worker} (exit code {code})" for worker, code in codes.items()) or "a worker"
        if any((code or 0) > 0 for code in codes.values()):
            return f"{who} failed; its own message is above"
        return (
            f"{who} died, killed from outside or for want of memory (fewer collector.workers or num_envs need less)"
        )

    def _exit_codes(self) -> list[int | None]:
        codes: list[int | None] = []
        for process in getattr(self.collector, "procs", ()):
            with suppress(ValueError):  # closed by TorchRL
                codes.append(process.exitcode)
        return codes
