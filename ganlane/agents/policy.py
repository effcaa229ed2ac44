"""Policies: the best action of a Q-network, with and without exploration, as TensorDictModules."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from ganlane import keys
from ganlane.agents.network import QNetwork, redraw_noise
from ganlane.errors import UserError

#: Gives the legal actions, [N, A] bool, of what the environment wrote.
LegalActions = Callable[[TensorDictBase], Tensor]


def allowed_values(values: Tensor, mask: Tensor | None) -> Tensor:
    """Action values [*, A] with minus infinity where ``mask`` [*, A] forbids; unchanged without a mask."""
    return values if mask is None else values.masked_fill(~mask, -torch.inf)


class GreedyPolicy(TensorDictModuleBase):
    """Writes the best ``action`` [N] int64 for ``observation`` [N, D]; never any noise, whatever the context says.

    Where the environment writes ``action_mask`` [N, A], it is the best of the allowed actions.
    """

    in_keys = [keys.OBSERVATION]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012
    #: Nothing is held per row, so an evaluation may move running episodes to other rows.
    rows_must_stay = False

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        self.network = network

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            values = self.network.values(tensordict.get(keys.OBSERVATION))
        values = allowed_values(values, tensordict.get(keys.ACTION_MASK, None))
        return tensordict.set(keys.ACTION, values.argmax(-1))


class ExploringPolicy(TensorDictModuleBase):
    """The policy that collects: network noise drawn anew at every step, mixed with random legal actions.

    It explores unless ``set_exploration_type`` says DETERMINISTIC, MODE or MEAN: outside any context, where TorchRL's
    noisy layers are silent, collecting would else be greedy by accident. Where the environment writes
    ``action_mask``, all actions are among the allowed ones, and ``legal`` is not asked.

    Args:
        network: its noise is redrawn in place, in one draw for all environments of the batch.
        generator: of the noise and of the random actions.
        legal: which actions may be drawn at random; all, if None.
    """

    in_keys = [keys.OBSERVATION]  # noqa: RUF012
    out_keys = [keys.ACTION, keys.CHOSEN_VALUE]  # noqa: RUF012

    def __init__(self, network: QNetwork, generator: torch.Generator, legal: LegalActions | None = None) -> None:
        super().__init__()
        self.network, self.generator, self.legal = network, generator, legal
        #: Probability of a random action; the agent anneals it.
        self.epsilon = 0.0

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` and ``chosen_action_value``."""
        explore = exploration_type() in (None, ExplorationType.RANDOM)
        if explore:
            redraw_noise(self.network, self.generator)
        with set_exploration_type(ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC):
            values = self.network.values(tensordict.get(keys.OBSERVATION))
        mask = tensordict.get(keys.ACTION_MASK, None)
        action = allowed_values(values, mask).argmax(-1)
        if explore and self.epsilon > 0.0:
            if mask is None:
                mask = torch.ones_like(values) if self.legal is None else self.legal(tensordict)
            # A fraction epsilon of the actions becomes a legal one, drawn uniformly.
            draw: dict[str, Any] = {"generator": self.generator, "device": self.generator.device}
            lottery = torch.rand(mask.shape, **draw) * mask
            action = torch.where(torch.rand(action.shape, **draw) < self.epsilon, lottery.argmax(-1), action)
        chosen = values.gather(-1, action[..., None])
        return tensordict.set(keys.ACTION, action).set(keys.CHOSEN_VALUE, chosen)


class MaskedPolicy(TensorDictModuleBase):
    """Any policy behind the environment's ``action_mask``: an action that is not allowed becomes 'keep the lane'.

    Agents of this package choose among the allowed actions themselves; it does not change them.

    Args:
        policy: writes ``action`` [N] int64.

    Raises:
        UserError: the environment has no mask.
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        super().__init__()
        self.policy = policy
        self.rows_must_stay = getattr(policy, "rows_must_stay", True)
        self.in_keys = list(dict.fromkeys([*policy.in_keys, keys.ACTION_MASK]))
        self.out_keys = list(policy.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        mask = tensordict.get(keys.ACTION_MASK, None)
        if mask is None:
            raise UserError(
                "this driver chooses among allowed actions, but the environment has no action_mask; make it with "
                "mask='safe' or 'legal'."
            )
        action = self.policy(tensordict).get(keys.ACTION)
        allowed = mask.gather(1, action[:, None])[:, 0]
        return tensordict.set(keys.ACTION, torch.where(allowed, action, keys.KEEP))
