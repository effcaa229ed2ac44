"""The collector: each step is one decision of all environments, in order of time."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents import Rainbow


class Collector:
    """Steps ``env``, batch [N], in this process, driven by the agent's exploring policy.

    ``env_state`` is the TensorDict with the environments' state. TorchRL's ``Collector`` does not
    expose it; here it is saved, so that a resumed run is exact.
    """

    def __init__(self, env: EnvBase) -> None:
        self.env = env
        self.environments = env.batch_size.numel()
        # The state before the next decision; what has ended is begun anew within a step.
        self.env_state: TensorDictBase = env.reset()

    def step(self, agent: Rainbow) -> TensorDictBase:
        """One decision of every environment, batch [N].

        Row i continues row i of the last step. ``next`` is the outcome before any reset: ended
        environments are reset in ``env_state``, not in the returned step.
        """
        # the policy writes its action into the state itself
        decided = agent.policy(self.env_state)
        # The step holds each row as it ended; in env_state such rows are reset already.
        step, self.env_state = self.env.step_and_maybe_reset(decided)
        return step

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
            # rows count on in steps of their number, so no episode is driven twice
            following = saved.get(keys.EPISODE) + self.environments
            self.env_state = self.env.reset(saved.set(keys.EPISODE, following))
        else:  # an environment without numbered episodes
            self.env_state = self.env.reset()


def pack(tensordict: TensorDictBase) -> dict[str, Any]:
    """A TensorDict as plain data, with its (nested) batch sizes."""
    # plain dictionaries, which torch.load reads without executing anything
    leaves = {
        key: pack(value) if isinstance(value, TensorDictBase) else value
        for key, value in tensordict.items()
    }
    return {
        "batch_size": list(tensordict.batch_size),
        "items": leaves,
    }


def unpack(packed: dict[str, Any]) -> TensorDict:
    """The TensorDict of :func:`pack`."""
    items = {
        key: unpack(value) if isinstance(value, dict) else value
        for key, value in packed["items"].items()
    }
    return TensorDict(items, batch_size=packed["batch_size"])
