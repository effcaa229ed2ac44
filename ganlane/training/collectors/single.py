"""``collector=single``: the environments are stepped in this process."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import Rainbow
from ganlane.training.checkpoints import pack, unpack
from ganlane.training.collectors.source import Source


class SingleSource(Source):
    """Steps ``env``, batch [N], by itself.

    ``carrier`` is the TensorDict that takes the environments' state from step to step. TorchRL's own ``Collector``
    would keep it to itself; here it is saved, and a resumed run is exact.
    """

    exact = True

    def __init__(self, env: EnvBase) -> None:
        self.env, self.environments = env, env.batch_size.numel()
        self.carrier: TensorDictBase = env.reset()

    def step(self, agent: Rainbow) -> TensorDictBase:
        """One decision; environments that ended start afresh in the carrier, not in the step."""
        step, self.carrier = self.env.step_and_maybe_reset(agent.policy(self.carrier))
        return step

    def state_dict(self, exact: bool) -> dict[str, Any]:
        """The carrier, or of it the episodes alone."""
        return pack(self.carrier if exact else self.carrier.select(keys.SEED, keys.EPISODE, strict=False))

    def load_state_dict(self, state: dict[str, Any], exact: bool) -> None:
        """Take over a carrier, or begin the episodes after those of ``state``, the first ones if it has none."""
        carrier = unpack(state)
        if carrier.batch_size != self.carrier.batch_size:
            raise ValueError(str(list(carrier.batch_size)))
        if exact:
            self.carrier = carrier
        elif keys.EPISODE in carrier:
            self.carrier = self.env.reset(carrier.set(keys.EPISODE, carrier.get(keys.EPISODE) + self.environments))
        else:
            self.carrier = self.env.reset()

    def close(self) -> None:
        """Nothing was started."""
