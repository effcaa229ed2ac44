"""What would have happened: branch a state, try each first action, go on with a base policy.

The state travels in the TensorDict, so it can be copied and driven on as often as one likes, exactly. That shows what
there is to win by a lane change, where an agent errs, and which crashes no driver could have avoided.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from ganlane import keys


class Branches(NamedTuple):
    """Per first action and row, [A, N]: discounted return, and whether it led to a hard crash within the horizon."""

    returns: Tensor
    crashed: Tensor

    def advantage(self) -> Tensor:
        """Return of the best first action over that of keeping the lane, [N]."""
        return self.returns.amax(0) - self.returns[keys.KEEP]


@torch.no_grad()
def branch(
    env: EnvBase,
    state: TensorDictBase,
    policy: TensorDictModuleBase,
    decisions: int,
    gamma: float = 1.0,
    actions: int = 3,
) -> Branches:
    """Try each first action in ``state`` and go on with ``policy``; ``state`` stays as it is.

    Args:
        env: writes ``reward`` [N, 1]; the traffic that follows is the one that would have followed.
        state: what ``env`` wrote, batch [N].
        policy: takes the decisions after the first one.
        decisions: how many in all; a row that ends earlier, or has ended in ``state``, earns nothing more.
        gamma: discount per decision.
        actions: A, the number of actions.
    """
    base = getattr(env, "base_env", env)
    last = getattr(base, "last_episodes", None)
    outcomes = [_follow(env, state, policy, action, decisions, gamma) for action in range(actions)]
    if last is not None:
        # Automatic resets go on from where the environment itself was, not from the branches.
        base.last_episodes = last
    returns, crashed = zip(*outcomes)
    return Branches(torch.stack(returns), torch.stack(crashed))


def _follow(
    env: EnvBase, state: TensorDictBase, policy: TensorDictModuleBase, first: int, decisions: int, gamma: float
) -> tuple[Tensor, Tensor]:
    """Discounted return [N] and hard crash [N] after the first action ``first`` and ``policy`` from then on."""
    at = state.clone(recurse=False)
    running = ~at.get("done")
    total = torch.zeros_like(at.get(keys.VEHICLES).get("x")[:, :1])
    crashed = torch.zeros_like(running)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for number in range(decisions):
            at = policy(at) if number else at.set(keys.ACTION, torch.full(at.batch_size, first, device=at.device))
            step = env.step(at)
            after = step.get("next")
            total = total + gamma**number * torch.where(running, after.get(keys.REWARD), 0.0)
            crashed = crashed | (running & after.get(keys.EVENTS).get("hard_crash"))
            running = running & ~after.get("done")
            at = step_mdp(step)
    return total[:, 0], crashed[:, 0]
