"""The collector: each step is one decision of all environments, in order of time."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import Rainbow


class Collector:
    """Steps environments in this process, driven by the agent's exploring policy.

    TorchRL's ``Collector`` does not expose the state of the environments; here it is saved, so that
    a resumed run is exact.

    Args:
        env: batch [N].

    Attributes:
        environments: N.
        env_state: TensorDict [N], the state before the next decision.
    """

    def __init__(self, env: EnvBase) -> None:
        self.env = env
        self.environments = env.batch_size.numel()
        # What has ended is begun anew within a step.
        self.env_state: TensorDictBase = env.reset()
        # Torch's number of threads is each thread's own.
        threads = torch.get_num_threads()
        self._driver = ThreadPoolExecutor(1, "driving", torch.set_num_threads, (threads,))

    def step(self, agent: Rainbow, meanwhile: Callable[[], None]) -> TensorDictBase:
        """One decision of every environment, batch [N].

        Row i continues row i of the last step. ``next`` is the outcome before any reset: ended
        environments are reset in ``env_state``, not in the returned step. ``meanwhile`` is called
        between the choice of the actions and their outcome; it may change the agent. On a CPU
        another thread drives at the same time.
        """
        with torch.no_grad():
            # The policy writes its action into the state itself.
            decided = agent.policy(self.env_state)

        # The kernel computes without Python's lock: 100,000 decisions on gan took 38 s instead of
        # 48 s on two cores. In this context, since it holds the number of the kernel's threads.
        if agent.device.type == "cpu":
            driving = self._driver.submit(copy_context().run, self._drive, decided)
            outcome = driving.result
        else:
            # A GPU computes on its own while the next calls are made.
            outcome = partial(self._drive, decided)
        meanwhile()

        # The step holds each row as it ended; in env_state such rows are reset already.
        step, self.env_state = outcome()
        return step

    @torch.no_grad()
    def _drive(self, decided: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        return self.env.step_and_maybe_reset(decided)

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The state of the environments; unless ``exact``, only their episode numbers."""
        if exact:
            return pack(self.env_state)
        return pack(self.env_state.select(keys.SEED, keys.EPISODE, strict=False))

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Continue from :meth:`state_dict` of environments of the same shape.

        Bit for bit if ``exact``, else with the episodes after those of ``state``.
        """
        saved = unpack(state)
        if exact:
            self.env_state = saved
        elif keys.EPISODE in saved:
            # Rows count on in steps of their number, so no episode is driven twice.
            following = saved.get(keys.EPISODE) + self.environments
            self.env_state = self.env.reset(saved.set(keys.EPISODE, following))
        else:  # an environment without numbered episodes
            self.env_state = self.env.reset()


def pack(tensordict: TensorDictBase) -> dict[str, Any]:
    """A TensorDict as plain data, with its (nested) batch sizes."""
    # Plain dictionaries, which torch.load reads without executing anything.
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
