"""Where the steps come from: one decision of all environments at a time, in the order of time.

The loop is the same for every :class:`Collector`. :class:`SingleCollector` steps the environments in this process;
in :mod:`ganlane.training.overlap` worker processes do, while the loop learns. Runs with these two can be resumed to
the same bits. The collectors of :mod:`ganlane.training.workers` are TorchRL's, in worker processes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import Rainbow
from ganlane.env.native_step import threads_for


class Collector(ABC):
    """Steps of N environments, driven by the agent's exploring policy."""

    #: N, over all processes.
    environments: int
    #: Whether a resumed run is the one it would have been, bit for bit.
    exact: bool
    #: Whether the loop learns between :meth:`begin` and :meth:`step`, and not after them.
    overlaps: bool = False

    def open(self, agent: Rainbow) -> None:  # noqa: B027 (nothing to do unless there are workers)
        """Start what collecting needs; :meth:`step` does it otherwise.

        Raises:
            UserError: it cannot be started.
        """

    def begin(self, agent: Rainbow) -> None:  # noqa: B027 (for those that overlap)
        """Set out on the next step with the agent's present weights, and come back before it is made."""

    @abstractmethod
    def step(self, agent: Rainbow) -> TensorDictBase:
        """One decision of every environment, batch [N], on the agent's device.

        Row i of a step continues row i of the last one; ``next`` is what followed before any reset.
        """

    @abstractmethod
    def state_dict(self, exact: bool) -> dict[str, Any]:
        """Tensors and plain data to go on from: ``exact``, or with the episodes after the present ones."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Go on from :meth:`state_dict`, made with environments of the same shape."""

    def close(self) -> None:  # noqa: B027
        """End what was started for collecting; again does no harm."""


class SingleCollector(Collector):
    """``collector=single``: steps ``env``, batch [N], in this process.

    ``env_state`` is the TensorDict that takes the environments' state from step to step. TorchRL's own ``Collector``
    would keep it to itself; here it is saved, and a resumed run is exact.
    """

    exact = True

    def __init__(self, env: EnvBase) -> None:
        self.env, self.environments = env, env.batch_size.numel()
        with threads_for(env):
            self.env_state: TensorDictBase = env.reset()

    def step(self, agent: Rainbow) -> TensorDictBase:
        """One decision; environments that ended start afresh in ``env_state``, not in the step."""
        decided = agent.policy(self.env_state)
        with threads_for(self.env):
            step, self.env_state = self.env.step_and_maybe_reset(decided)
        return step

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The state of the environments, or of it the episodes alone."""
        return pack(self.env_state if exact else self.env_state.select(keys.SEED, keys.EPISODE, strict=False))

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Take over the state, or begin the episodes after those of ``state``, the first ones if it has none."""
        saved = unpack(state)
        if exact:
            self.env_state = saved
        elif keys.EPISODE in saved:
            self.env_state = self.env.reset(saved.set(keys.EPISODE, saved.get(keys.EPISODE) + self.environments))
        else:
            self.env_state = self.env.reset()


def pack(tensordict: TensorDictBase) -> dict[str, Any]:
    """A TensorDict as plain data, nested batch sizes included."""
    leaves = {key: pack(value) if isinstance(value, TensorDictBase) else value for key, value in tensordict.items()}
    return {"batch_size": list(tensordict.batch_size), "items": leaves}


def unpack(packed: dict[str, Any]) -> TensorDict:
    """The TensorDict of :func:`pack`."""
    items = {key: unpack(value) if isinstance(value, dict) else value for key, value in packed["items"].items()}
    return TensorDict(items, batch_size=packed["batch_size"])
