"""Episodes with every action recorded, so that they can be driven again; and what a crash hit.

The simulation is deterministic, so :func:`replay` gives the same rollout from its episode number and actions.
Rule-driven traffic does so bit for bit in any batch, generated traffic in batches of the same size (its network's
matrix products round differently in others).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ganlane import keys
from ganlane.errors import UserError
from ganlane.evaluation.episodes import OTHER, SIDES, contact_side, start_of
from ganlane.sim.state import Vehicles, road_in


@dataclass(frozen=True)
class Rollout:
    """One episode driven to its end.

    Attributes:
        end: the event that ended it (:data:`ganlane.keys.END_EVENTS`, or ``other``).
        actions: one per decision.
        reward: undiscounted return; 0 where the environment pays none.
        contact: what a hard crash hit (:data:`SIDES`); ``none`` without one.
        changing: whether the ego was changing lanes in its last decision.
    """

    episode: int
    end: str
    actions: tuple[int, ...]
    reward: float
    distance_m: float
    contact: str
    changing: bool

    @property
    def safe(self) -> bool:
        """Whether the ego neither crashed nor left the road."""
        return self.end not in ("hard_crash", "out_of_road")


@torch.no_grad()
def roll_out(env: EnvBase, policy: TensorDictModuleBase, episodes: Sequence[int], seed: int) -> list[Rollout]:
    """Drive ``episodes`` of ``seed`` with ``policy``, all side by side; one rollout each, in the order given.

    ``env`` may have fewer rows than that, or more.
    """
    state = start_rows(env, episodes, seed)
    places = torch.arange(len(episodes), device=env.device)
    totals = torch.zeros(len(episodes), dtype=state.get(keys.VEHICLES).get("x").dtype, device=env.device)
    taken: list[tuple[Tensor, Tensor]] = []
    found: dict[int, Rollout] = {}
    while len(found) < len(episodes):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = policy(state.clone(recurse=False)).get(keys.ACTION)
        state, reward = step_rows(env, state, torch.arange(len(places), device=env.device), action)
        totals[places] += reward
        taken.append((places, action))
        done = state.get("done")[:, 0]
        for row in done.nonzero()[:, 0].tolist():
            place = int(places[row])
            actions = tuple(int(action[who == place]) for who, action in taken)
            found[place] = _rollout(env, state[row : row + 1], episodes[place], actions, float(totals[place]))
        state, places = state[~done], places[~done]
    return [found[place] for place in range(len(episodes))]


def _rollout(env: EnvBase, after: TensorDictBase, episode: int, actions: tuple[int, ...], reward: float) -> Rollout:
    """The rollout of the one row ``after``, which has just ended."""
    events, ego = after.get(keys.EVENTS), after.get(keys.EGO)
    end = next((name for name in keys.END_EVENTS if bool(events.get(name))), OTHER)
    side = contact_side(Vehicles.of(after.get(keys.VEHICLES)), road_in(after, base_of(env).road))
    contact = SIDES[int(side)] if end == "hard_crash" else SIDES[0]
    changing = bool(ego.get("change_direction") != 0)
    return Rollout(episode, end, actions, reward, float(ego.get("distance")), contact, changing)


def replay(env: EnvBase, actions: Mapping[int, Sequence[int]], seed: int) -> list[Rollout]:
    """The rollouts of episodes (number to actions) of ``seed``, driven again; by episode."""
    return roll_out(env, ScriptedPolicy(actions), sorted(actions), seed) if actions else []


class ScriptedPolicy(TensorDictModuleBase):
    """Takes given actions in given episodes, and keeps its lane after the last of them."""

    in_keys = [keys.EPISODE, keys.EGO]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self, actions: Mapping[int, Sequence[int]]) -> None:
        super().__init__()
        longest = max(len(taken) for taken in actions.values()) + 1
        self.episodes = torch.tensor(sorted(actions))
        padded = [[*actions[number], *[keys.KEEP] * (longest - len(actions[number]))] for number in sorted(actions)]
        self.table = torch.tensor(padded, dtype=torch.int64)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        row = torch.searchsorted(self.episodes, tensordict.get(keys.EPISODE).cpu())
        decision = tensordict.get(keys.EGO).get("decisions").cpu().clamp_max(self.table.shape[1] - 1)
        action = self.table[row, decision]
        return tensordict.set(keys.ACTION, action.to(tensordict.get(keys.EPISODE).device))


def base_of(env: EnvBase) -> EnvBase:
    """The environment below the transforms."""
    return getattr(env, "base_env", env)


def step_rows(env: EnvBase, state: TensorDictBase, rows: Tensor, action: Tensor) -> tuple[TensorDictBase, Tensor]:
    """The state after one decision from ``rows`` of ``state``, and the reward; as many at a time as ``env`` has.

    The last batch is filled up with its last row, so that all batches have one size: a network rounds alike in all.
    """
    count, size = action.shape[0], env.batch_size[0]
    states, rewards = [], []
    for start in range(0, count, size):
        batch = torch.arange(start, start + size, device=action.device).clamp_max(count - 1)
        after = env.step(state[rows[batch]].set(keys.ACTION, action[batch])).get("next")
        real = min(size, count - start)
        states.append(_decision_state(after)[:real])
        rewards.append(after.get(keys.REWARD)[:real, 0])
    return torch.cat(states), torch.cat(rewards)


def start_rows(env: EnvBase, episodes: Sequence[int], seed: int) -> TensorDictBase:
    """The first states of any number of episodes.

    Raises:
        UserError: there is none.
    """
    if len(episodes) == 0:
        raise UserError("episodes: none were asked for; expected at least one, give for instance episodes=100.")
    size = env.batch_size[0]
    chunks = [episodes[start : start + size] for start in range(0, len(episodes), size)]
    return torch.cat([_decision_state(env.reset(start_of(env, chunk, seed)))[: len(chunk)] for chunk in chunks])


def _decision_state(state: TensorDictBase) -> TensorDictBase:
    """What the next decision and step need."""
    return state.exclude(keys.REWARD, keys.REWARD_TERMS, keys.ACTION)
