"""What the loop asks of a collector."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from ganlane.agents import Rainbow


class Source(ABC):
    """Steps of N environments, driven by the agent's exploring policy."""

    #: N, over all processes.
    environments: int
    #: Whether a resumed run is the one it would have been, bit for bit.
    exact: bool

    def open(self, agent: Rainbow) -> None:  # noqa: B027 (most sources have nothing to do)
        """Start what collecting needs; :meth:`step` does it otherwise.

        Raises:
            UserError: it cannot be started.
        """

    @abstractmethod
    def step(self, agent: Rainbow) -> TensorDictBase:
        """One decision of every environment, batch [N], on the agent's device.

        Row i of a step goes on where row i of the last one ended; ``next`` is what followed before any reset.
        """

    @abstractmethod
    def state_dict(self, exact: bool) -> dict[str, Any]:
        """Tensors and plain data to go on from: ``exact``, or with the episodes after the present ones."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Go on from :meth:`state_dict`.

        Raises:
            ValueError: it was made with environments of another shape, which is the message.
        """

    @abstractmethod
    def close(self) -> None:
        """End what was started for collecting; again does no harm."""


def source_of(env: EnvBase | Source) -> Source:
    """``env`` itself where it is a source, else a source that steps it in this process."""
    from ganlane.training.collectors.single import SingleSource

    return env if isinstance(env, Source) else SingleSource(env)
