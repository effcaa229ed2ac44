"""A driver who knows what comes: a beam search over lane changes, on the simulator itself.

Per episode up to K states are alive. Each is driven on by one decision with every action that makes
a difference there; what crashed is dropped, what came to nearly the same is merged, and K of the
rest are kept, spread over lanes and over progress (:func:`choose`). The search ends with the first
state that reaches the episode's end, or when all are dead. It is a heuristic: a sequence that it
finds is proof (:func:`ganlane.evaluation.episodes.replay`), none found is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.agents.drivers import legal_actions
from ganlane.errors import UserError
from ganlane.evaluation.episodes import base_of, start_rows, step_rows
from ganlane.keys import EGO_INDEX

#: States that agree in lane and change under way and within these steps are one: x and y in m,
#: speed in m/s.
MERGED = {"x": 1.0, "y": 0.5, "speed": 0.5}


@dataclass(frozen=True)
class Plan:
    """What the search found for one episode.

    Attributes:
        actions: one per decision, to the episode's end; of a state that lived longest where
            ``found`` is false.
        reward: their undiscounted return; 0 where the environment pays none.
        widest: most states that were alive at once; below the beam, nothing but like states was
            ever dropped.
    """

    episode: int
    found: bool
    actions: tuple[int, ...]
    reward: float
    widest: int


@dataclass
class _Front:
    """The states alive after some decision.

    Whose they are, what they earned, and how they came about.
    """

    state: TensorDictBase
    owner: Tensor
    total: Tensor
    #: Per decision so far, of every state then alive: its predecessor's row, and the action taken
    #: there.
    trail: list[tuple[Tensor, Tensor]]

    def actions(self, row: int) -> tuple[int, ...]:
        """The actions that led to the state in ``row``."""
        taken = []
        for parents, actions in reversed(self.trail):
            taken.append(int(actions[row]))
            row = int(parents[row])
        return tuple(reversed(taken))


@torch.no_grad()
def beam_search(
    env: EnvBase, episodes: Sequence[int], seed: int, beam: int, by_reward: bool = False
) -> list[Plan]:
    """Search ``episodes`` of ``seed`` side by side; one plan each, in the order given.

    Args:
        env: steps as many rows at a time as it has; its size makes no difference to rule-driven
            traffic.
        beam: K, states kept per episode.
        by_reward: keep those with the highest return in each lane rather than the most different
            ones, for an optimistic bound of the reward; needs an environment that pays one.

    Raises:
        UserError: ``beam`` is not positive, or no episode is given.
    """
    if beam < 1:
        raise UserError(f"beam={beam}: expected at least 1 state per episode; give for instance 8.")
    base = base_of(env)
    last = getattr(base, "last_episodes", None)
    plans = _Search(env, list(episodes), beam, by_reward).run(seed)
    if last is not None:
        # Automatic resets go on from where the environment itself was.
        base.last_episodes = last
    return plans


class _Search:
    """One search: its episodes, and what is known of them so far."""

    def __init__(self, env: EnvBase, episodes: list[int], beam: int, by_reward: bool) -> None:
        self.env, self.episodes, self.beam, self.by_reward = env, episodes, beam, by_reward
        self.plans: dict[int, Plan] = {}
        self.widest = torch.ones(len(episodes), dtype=torch.int64, device=env.device)

    def run(self, seed: int) -> list[Plan]:
        """Drive on until every episode has its plan."""
        front = self._start(seed)
        while front.owner.numel() > 0:
            front = self._advance(front)
        return [self.plans[owner] for owner in range(len(self.episodes))]

    def _start(self, seed: int) -> _Front:
        state = start_rows(self.env, self.episodes, seed)
        owner = torch.arange(len(self.episodes), device=self.env.device)
        return _Front(state, owner, torch.zeros_like(state.get(keys.VEHICLES).get("x")[:, 0]), [])

    def _advance(self, front: _Front) -> _Front:
        """One decision of all states alive."""
        rows, action = self._branches(front.state).nonzero().unbind(1)
        state, reward = step_rows(self.env, front.state, rows, action)
        total, owner = front.total[rows] + reward, front.owner[rows]
        after = _Front(state, owner, total, [*front.trail, (rows, action)])
        events, done = state.get(keys.EVENTS), state.get("done")[:, 0]
        dead = (events.get("hard_crash") | events.get("out_of_road"))[:, 0]
        self._conclude(after, done & ~dead, True)
        alive = ~done & ~self._concluded(owner)
        self._conclude(after, _last_of_their_kind(owner, alive) & ~self._concluded(owner), False)
        living = alive.nonzero()[:, 0]
        kept = living[
            choose(state[living], owner[living], total[living], self.beam, self.by_reward)
        ]
        self.widest = torch.maximum(
            self.widest, torch.bincount(owner[kept], minlength=len(self.widest))
        )
        return _Front(
            state[kept], owner[kept], total[kept], [*front.trail, (rows[kept], action[kept])]
        )

    def _branches(self, state: TensorDictBase) -> Tensor:
        """Which actions to try, bool [rows, 3]: legal ones, and in a change those that are heard."""
        base = base_of(self.env)
        legal = legal_actions(state, base.road)
        if base.ego.abort_lane_change:
            return legal
        free = state.get(keys.EGO).get("change_direction") == 0
        return legal & (free[:, None] | (torch.arange(3, device=free.device) == keys.KEEP))

    def _concluded(self, owner: Tensor) -> Tensor:
        """Whether the plan of these episodes is known."""
        known = torch.zeros(len(self.episodes), dtype=torch.bool, device=owner.device)
        known[list(self.plans)] = True
        return known[owner]

    def _conclude(self, front: _Front, rows: Tensor, found: bool) -> None:
        """Note the plans of the episodes that ``rows`` (bool) belong to: the best of each."""
        best_first = order(front.owner, -front.total)
        for row in best_first[rows[best_first]].tolist():
            owner = int(front.owner[row])
            if owner not in self.plans:
                plan = (self.episodes[owner], found, front.actions(row), float(front.total[row]))
                self.plans[owner] = Plan(*plan, int(self.widest[owner]))


def _last_of_their_kind(owner: Tensor, alive: Tensor) -> Tensor:
    """Which rows belong to an episode that has no row alive."""
    living = torch.zeros(int(owner.max()) + 1, dtype=torch.bool, device=owner.device)
    living[owner[alive]] = True
    return ~living[owner]


def choose(
    state: TensorDictBase, owner: Tensor, total: Tensor, beam: int, by_reward: bool
) -> Tensor:
    """At most ``beam`` rows of ``state`` per episode, as their numbers in growing order.

    Args:
        state: batch [rows].
        owner: which episode each row belongs to, [rows] int64.
        total: what each row has earned, [rows].
        beam: rows kept per episode.
        by_reward: within a lane keep those that earned most, rather than the foremost and the
            hindmost.
    """
    vehicles = state.get(keys.VEHICLES)
    ego = {name: vehicles.get(name)[:, EGO_INDEX] for name in MERGED}
    cell = (
        owner,
        vehicles.get("target_lane")[:, EGO_INDEX],
        state.get(keys.EGO).get("change_direction"),
    )
    near = [torch.floor(value / MERGED[name]) for name, value in ego.items()]
    gain = total if by_reward else ego["x"]
    distinct = order(*cell, *near, -gain)
    distinct = distinct[rank(*(column[distinct] for column in (*cell, *near))) == 0]
    # Within a lane: the best first, or the foremost and the hindmost in turn.
    ranked = distinct[order(*(column[distinct] for column in cell), -gain[distinct])]
    place = rank(*(column[ranked] for column in cell))
    if not by_reward:
        backwards = rank(*(column[ranked].flip(0) for column in cell)).flip(0)
        place = torch.minimum(place, backwards)
    chosen = ranked[order(owner[ranked], place)]
    return chosen[rank(owner[chosen]) < beam].sort().values


def order(*columns: Tensor) -> Tensor:
    """Rows sorted by the first column, ties by the second, and so on; the rest as they stand."""
    rows = torch.arange(columns[0].shape[0], device=columns[0].device)
    for column in reversed(columns):
        rows = rows[torch.argsort(column[rows], stable=True)]
    return rows


def rank(*columns: Tensor) -> Tensor:
    """Of sorted rows: how many of the same values stand before each, [rows] int64."""
    index = torch.arange(columns[0].shape[0], device=columns[0].device)
    new = torch.zeros_like(index, dtype=torch.bool)
    new[:1] = True
    for column in columns:
        new[1:] |= column[1:] != column[:-1]
    return index - torch.where(new, index, 0).cummax(0).values if len(index) else index
