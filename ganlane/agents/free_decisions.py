"""Returns over the decisions at which the ego is free to act: a lane change counts as one decision, however long.

During a lane change commands are ignored (:func:`ganlane.sim.ego.apply_action`), so nothing is learnt there: a
transition starts where the ego is free, and leads to the first observation at least n decisions later at which it is
free again. This makes the literal Table III, which does not tell of a change under way, Markov where it is asked.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError


@dataclass
class Pending:
    """Transitions under way, [n, N, ...]: what they began with, and their return so far."""

    observation: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor
    length: Tensor
    active: Tensor


class FreeDecisionWindow:
    """Transitions of N environments from free ego to free ego; stands where :class:`NStepWindow` does.

    One that starts in decision t waits in place ``t % n``: whenever the ego is free, all that started n or more
    decisions ago are complete, so n places are enough however long a lane change takes.
    """

    def __init__(self, n: int, gamma: float) -> None:
        self.n, self.gamma = n, gamma
        self.place = 0
        self.pending: Pending | None = None

    def push(self, step: TensorDictBase) -> TensorDict | None:
        """Add one step; return the transitions that it completes, batch [any number], or None without any.

        Args:
            step: as in :meth:`NStepWindow.push`, and with ``ego.change_direction`` [N] before and after it.

        Returns:
            The keys of :meth:`NStepWindow.push`; ``steps_to_next_obs`` counts decisions.

        Raises:
            UserError: the environment does not tell of lane changes.
        """
        after = step.get("next")
        free, free_after = is_free(step), is_free(after)
        pending = self.pending = self._started(step, free)
        reward, done = after.get("reward"), after.get("done")
        pending.reward = pending.reward + pending.discount * reward
        pending.discount = pending.discount * self.gamma
        pending.length = pending.length + 1
        complete = pending.active & (done | (free_after & (pending.length >= self.n)))
        pending.active = pending.active & ~complete
        return transitions(pending, complete, after)

    def _started(self, step: TensorDictBase, free: Tensor) -> Pending:
        """What is under way, with this step's own where the ego is free; nothing of it shared with the past."""
        observation, action, reward = step.get("observation"), step.get("action"), step.get(("next", "reward"))
        old = self.pending or nothing(self.n, observation, action, reward)
        here = torch.arange(self.n, device=reward.device)[:, None, None] == self.place
        starts = here & free
        self.place = (self.place + 1) % self.n
        return Pending(
            torch.where(starts, observation, old.observation),
            torch.where(starts[..., 0], action, old.action),
            torch.where(starts, 0.0, old.reward),
            torch.where(starts, 1.0, old.discount),
            torch.where(starts, 0.0, old.length),
            old.active | starts,
        )

    def state_dict(self) -> dict[str, Any]:
        """The transitions under way, as a plain dictionary of tensors."""
        return {"place": self.place, "pending": None if self.pending is None else asdict(self.pending)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.place = state["place"]
        self.pending = None if state["pending"] is None else Pending(**state["pending"])


def nothing(n: int, observation: Tensor, action: Tensor, reward: Tensor) -> Pending:
    """``n`` places without a transition, shaped after one step of N environments."""
    zero = torch.zeros_like(reward).expand(n, *reward.shape)
    first, second = (tensor.expand(n, *tensor.shape) for tensor in (observation, action))
    return Pending(first, second, zero, zero, zero, zero.bool())


def is_free(state: TensorDictBase) -> Tensor:
    """Whether a command would be obeyed, bool [N, 1]."""
    direction = state.get((keys.EGO, "change_direction"), None)
    if direction is None:
        raise UserError(
            "agent.decide_when_free=true: the environment does not tell when a lane change is under way "
            "(ego.change_direction); set agent.decide_when_free=false."
        )
    return (direction == 0)[:, None]


def transitions(pending: Pending, complete: Tensor, after: TensorDictBase) -> TensorDict | None:
    """Those of ``pending`` that are ``complete`` [n, N, 1], which led to ``after``; None without any."""
    place, row = complete[..., 0].nonzero(as_tuple=True)
    if len(row) == 0:
        return None
    mask = after.get(keys.ACTION_MASK, None)
    led_to = {
        **({} if mask is None else {keys.ACTION_MASK: mask[row]}),
        "observation": after.get("observation")[row],
        "reward": pending.reward[place, row],
        "terminated": after.get("terminated")[row],
    }
    content = {
        "observation": pending.observation[place, row],
        "action": pending.action[place, row],
        "steps_to_next_obs": pending.length[place, row],
        "next": TensorDict(led_to, [len(row)]),
    }
    return TensorDict(content, [len(row)])
