"""n-step returns over a batch of environments, exact across ends.

TorchRL's ``MultiStepTransform`` leaves ``terminated`` of the first step in place, and so bootstraps
past a crash.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys


class Step(NamedTuple):
    """One decision of N environments.

    Attributes:
        observation: before it, [N, D].
        action: [N].
        reward: [N, 1].
        following: the observation after it, before any reset, [N, D].
        terminated, done: bool [N, 1].
        following_mask: which actions are allowed after it, bool [N, A]; None where the environment
            has no mask.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    following: Tensor
    terminated: Tensor
    done: Tensor
    following_mask: Tensor | None = None

    @classmethod
    def copied(cls, step: TensorDictBase) -> Step:
        """The tensors of a step, copied: the environment may write into its own afterwards."""
        after = step.get("next")
        names = ("reward", "observation", "terminated", "done")
        tensors = [step.get("observation"), step.get("action"), *map(after.get, names)]
        if keys.ACTION_MASK in after:
            tensors.append(after.get(keys.ACTION_MASK))
        return cls(*(tensor.clone() for tensor in tensors))


class NStepWindow:
    """The last ``n`` steps of N environments; each new one gives the transition of the oldest.

    So every step but the first n - 1 gives one transition per environment, n - 1 steps late. Its
    return ends at the first ``done`` among its n steps, and so do its next observation and its
    ``terminated``: a truncated episode bootstraps from its true last observation, a terminated one
    not at all.

    Args:
        n: steps per transition.
        gamma: discount per decision.
    """

    def __init__(self, n: int, gamma: float) -> None:
        self.n = n
        self.gamma = gamma
        # Between two calls of push() at most n - 1.
        self.steps: list[Step] = []

    def push(self, step: TensorDictBase) -> TensorDict | None:
        """Add one step; return the transition of the oldest, batch [N], or None until there are n.

        Args:
            step: batch [N], with ``observation`` [N, D], ``action`` [N] and ``next``'s
                ``observation`` (before any reset), ``reward``, ``terminated`` and ``done`` [N, 1].

        Returns:
            ``observation``, ``action``, ``steps_to_next_obs`` [N, 1] (the exponent of the
            discount), and ``next``'s ``observation``, ``reward`` (the n-step return),
            ``terminated``, and ``action_mask`` where there is one.
        """
        # The oldest step is complete once there are n.
        self.steps.append(Step.copied(step))
        if len(self.steps) < self.n:
            return None

        # It gets its transition now and is not needed again. Rewards of later steps are added as
        # long as no episode has ended in between.
        first = self.steps.pop(0)
        reward = first.reward
        following = first.following
        mask = first.following_mask
        terminated = first.terminated
        # Number of decisions whose rewards are summed, [N, 1].
        length = torch.ones_like(reward)

        # Where no episode has ended between the oldest step and the one at hand, [N, 1].
        running = ~first.done
        for power, after in enumerate(self.steps, start=1):
            reward = reward + running * (self.gamma**power * after.reward)
            # What follows is the end of the last step that still belongs to it.
            following = torch.where(running, after.following, following)
            if mask is not None and after.following_mask is not None:
                mask = torch.where(running, after.following_mask, mask)
            terminated = torch.where(running, after.terminated, terminated)
            length = length + running
            running = running & ~after.done

        size = reward.shape[:1]
        end = {"observation": following, "reward": reward, "terminated": terminated}
        if mask is not None:
            end[keys.ACTION_MASK] = mask
        transition = {
            "observation": first.observation,
            "action": first.action,
            "steps_to_next_obs": length,
            "next": TensorDict(end, size),
        }
        return TensorDict(transition, size)

    def state_dict(self) -> dict[str, Any]:
        """The steps in the window, as plain dictionaries of tensors."""
        # Without them a resumed run would lose its last n - 1 steps.
        return {"steps": [step._asdict() for step in self.steps]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.steps = [Step(**step) for step in state["steps"]]
