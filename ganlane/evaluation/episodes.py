"""Driving given episodes: one row of facts about each, or a rollout with every action, which can be
driven again.

:func:`run_episodes` drives the rows of a batch side by side. A row whose episode has ended takes
the next one that has not been driven yet, so none waits for the slowest. Once all have been handed
out, the last ones move to smaller batches. The simulation is deterministic, so :func:`replay` gives
the same :class:`Rollout` from its episode number and actions: rule-driven traffic bit for bit in
any batch, generated traffic in batches of the same size (its network's matrix products round
differently in others).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import polars as pl
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from ganlane import keys
from ganlane.errors import UserError
from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.state import STRAIGHT, Road, Vehicles, road_in

#: Decisions between two looks at which rows have ended. A look waits for the device and a reset
#: costs about a tenth of a decision; a row that has ended waits 3.5 decisions on average, of more
#: than 200 in an episode.
CHECK_EVERY = 8
#: A batch of at most so many rows is not made smaller: fewer are hardly faster.
SMALL_BATCH = 16
#: The reason of an episode that something outside the environment ended (a user's own transform).
OTHER = "other"
#: Where the other vehicle of a crash was.
SIDES = ("none", "ahead", "side", "behind")
_AHEAD, _SIDE, _BEHIND = 1, 2, 3


def run_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    episodes: Sequence[int],
    seed: int,
    on_progress: Callable[[int, int], None] | None = None,
    make_smaller: Callable[[int], EnvBase] | None = None,
) -> pl.DataFrame:
    """Drive exactly ``episodes`` of ``seed``, each to its own end; one row per episode, in the
    order given.

    Which episodes are counted does not depend on how long any of them takes, so short ones are not
    favoured. The numbers are the same in any batch, with generated traffic up to rounding. The
    policy acts deterministically.

    Args:
        env: batched environment, batch size ``[N]``, whose ``reset`` takes ``seed`` and ``episode``
            in the tensordict, and as an argument ``next_episode`` [N], which the rows of a
            ``_reset`` mask start (:class:`ganlane.env.HighwayEnv` and what is built around it).
        policy: writes ``action``; reads the observation or the raw state.
        episodes: their numbers.
        on_progress: called now and then with (episodes finished, episodes in all).
        make_smaller: makes ``env`` with fewer rows; the last episodes move there when at most half
            of the rows are still driving. Not used where something is held per row: by traffic with
            ``rows_must_stay``, and by every policy without ``rows_must_stay = False``.

    Returns:
        Columns ``episode, seed, reason`` (:data:`ganlane.keys.END_EVENTS`, or ``other``),
        ``soft_crash`` and ``soft_crash_behind`` (onsets), ``had_soft_crash``, ``reward``
        (undiscounted return), ``reward_*`` (each term's sum), ``decisions``, ``duration_s``,
        ``distance_m``, ``mean_speed_mps`` (distance over time), ``lane_changes``, and ``at_fault``
        of a hard crash (:func:`ego_at_fault`; else null).

    Raises:
        UserError: no episodes are asked for, the environment is not batched in one dimension, or
            its reset ignores ``next_episode``.
    """
    if len(env.batch_size) != 1:
        shape = list(env.batch_size)
        raise UserError(
            f"env: batch size {shape} was found, expected [N]; build the environment with N rows."
        )
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        counts = _Evaluation(env, policy, list(episodes), seed, make_smaller).run(on_progress)
    return _episode_rows(counts, list(episodes), seed)


def start_of(env: EnvBase, numbers: Sequence[int], seed: int) -> TensorDict:
    """The tensordict that makes ``env.reset`` start these episodes; the last one also fills the
    rows left over.

    :class:`UserError` for none.
    """
    if len(numbers) == 0:
        raise UserError(
            "episodes: none were asked for; expected at least one, give for instance episodes=100."
        )
    rows = env.batch_size[0]
    padded = list(numbers) + [numbers[-1]] * (rows - len(numbers))
    episode = torch.tensor(padded, dtype=torch.int64, device=env.device)
    return TensorDict(
        {keys.SEED: torch.full_like(episode, seed), keys.EPISODE: episode},
        [rows],
        device=env.device,
    )


class _Evaluation:
    """Episodes on their way through the rows of an environment.

    Arguments as in :func:`run_episodes`.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        numbers: list[int],
        seed: int,
        make_smaller: Callable[[int], EnvBase] | None,
    ) -> None:
        rows, self.total = env.batch_size[0], len(numbers)
        rows_stay = getattr(getattr(env, "traffic", None), "rows_must_stay", False)
        self.env, self.policy = env, policy
        self.make_smaller = (
            None if rows_stay or getattr(policy, "rows_must_stay", True) else make_smaller
        )
        # What holds something per row outside the tensordict might not stand being driven on after
        # an end.
        self.check_every = 1 if rows_stay else CHECK_EVERY
        self.numbers = torch.tensor(numbers, dtype=torch.int64, device=env.device)
        # Where the episode of a row stands in the list, [N]; the list's length in spare rows.
        self.place = torch.arange(rows, device=env.device).clamp_max(self.total)
        self.handed_out = min(rows, self.total)
        # Places and counts of the episodes that have ended.
        self.finished: list[tuple[Tensor, dict[str, Tensor]]] = []
        self.state: TensorDictBase = env.reset(start_of(env, numbers[:rows], seed))
        self.counts = _Counts(self.place < self.total)

    def run(self, on_progress: Callable[[int, int], None] | None) -> dict[str, Tensor]:
        """Drive all episodes to their ends.

        The counts by name, each [E], in the order of the episodes.
        """
        done = 0
        while done < self.total:
            for _ in range(self.check_every):
                after = self.env.step(self.policy(self.state))
                self.counts.add(after["next"])
                self.state = step_mdp(after)
            # Save the counts of the episodes that have ended; their rows are spare then.
            ended = ((self.place < self.total) & ~self.counts.driving).nonzero()[:, 0]
            if len(ended) > 0:
                self.finished.append((self.place[ended].cpu(), self.counts.of(ended)))
                self.place[ended] = self.total
            done = sum(len(places) for places, _ in self.finished)
            if on_progress is not None:
                on_progress(done, self.total)
            if done < self.total:
                self._go_on()
        order = torch.cat([places for places, _ in self.finished]).argsort()
        return {
            name: torch.cat([counts[name] for _, counts in self.finished])[order]
            for name in self.finished[0][1]
        }

    def _go_on(self) -> None:
        """Give spare rows the next episodes.

        Without any, start the last ones again or leave such rows out.
        """
        driving = self.counts.driving.nonzero()[:, 0]
        rows = self.env.batch_size[0]
        wide = rows > SMALL_BATCH and 2 * len(driving) <= rows
        if wide and self.handed_out == self.total and self.make_smaller is not None:
            self.env = self.make_smaller(len(driving))
            self.state, self.place = self.state[driving], self.place[driving]
            self.counts.select(driving)
            return
        new = (~self.counts.driving).nonzero()[: self.total - self.handed_out, 0]
        self.place[new] = torch.arange(
            self.handed_out, self.handed_out + len(new), device=self.place.device
        )
        self.handed_out += len(new)
        self.counts.begin(new)
        # Spare rows that have ended start theirs again, uncounted.
        mask = self.state["done"] & (self.place == self.total)[:, None]
        mask[new] = True
        if not bool(mask.any()):
            return
        number = self.numbers[self.place.clamp_max(self.total - 1)]
        wanted = torch.where(self.place < self.total, number, self.state[keys.EPISODE])
        self.state = self.env.reset(self.state.set("_reset", mask), next_episode=wanted)
        if not torch.equal(self.state[keys.EPISODE], wanted):
            raise UserError(
                "env: its reset did not start the episodes that it was given; take next_episode [N] in _reset and "
                "start it in the rows of the _reset mask, as ganlane.env.HighwayEnv does."
            )


class _Counts:
    """Sums and last values of the rows ``driving`` [N] bool, each until its first end."""

    def __init__(self, driving: Tensor) -> None:
        self.driving = driving
        self._sums: dict[str, Tensor] = {}
        self._last: dict[str, Tensor] = {}
        self._vehicles: Vehicles | None = None

    def add(self, after: TensorDictBase) -> None:
        """Count one decision, from the tensordict after it (``next``).

        Reads nothing back, so it never waits.
        """
        events, ego, terms = after[keys.EVENTS], after[keys.EGO], after.get(keys.REWARD_TERMS, None)
        summed = {"reward": after[keys.REWARD]}
        summed |= (
            {} if terms is None else {f"reward_{name}": value for name, value in terms.items()}
        )
        summed |= {name: events[name] for name in (keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)}
        for name, value in summed.items():
            flat = value.reshape(value.shape[0]).double()
            counted = torch.where(self.driving, flat, torch.zeros_like(flat))
            self._sums[name] = self._sums[name] + counted if name in self._sums else counted
        last = {name: ego[name] for name in ("distance", "lane_changes", "decisions")}
        last |= {"duration_s": after[keys.STEP].double() * keys.PHYSICS_STEP_S}
        last |= {name: events[name].squeeze(-1) for name in keys.END_EVENTS}
        for name, value in last.items():
            before = self._last.get(name)
            self._last[name] = (
                value.clone() if before is None else torch.where(self.driving, value, before)
            )
        if keys.VEHICLES in after:
            now = Vehicles.of(after[keys.VEHICLES])
            self._vehicles = now.where(
                self.driving, now if self._vehicles is None else self._vehicles
            )
        self.driving = self.driving & ~after["done"].squeeze(-1)

    def of(self, rows: Tensor) -> dict[str, Tensor]:
        """All counts of ``rows`` [K] (int64) by name, each [K], on the CPU."""
        counts = {name: value[rows].cpu() for name, value in (self._sums | self._last).items()}
        if self._vehicles is not None:
            counts["at_fault"] = ego_at_fault(
                Vehicles(*(field[rows] for field in self._vehicles))
            ).cpu()
        return counts

    def begin(self, rows: Tensor) -> None:
        """Count from 0 again in ``rows`` (int64), in which other episodes start."""
        self.driving[rows] = True
        for value in self._sums.values():
            value[rows] = 0.0

    def select(self, rows: Tensor) -> None:
        """Continue with ``rows`` [K] (int64) alone, in that order."""
        self.driving = self.driving[rows]
        self._sums = {name: value[rows] for name, value in self._sums.items()}
        self._last = {name: value[rows] for name, value in self._last.items()}
        if self._vehicles is not None:
            self._vehicles = Vehicles(*(field[rows] for field in self._vehicles))


def _episode_rows(counts: dict[str, Tensor], numbers: list[int], seed: int) -> pl.DataFrame:
    """What :func:`run_episodes` returns."""
    terms = [name for name in counts if name.startswith("reward_")]
    ends = (pl.when(pl.col(event)).then(pl.lit(event)) for event in keys.END_EVENTS)
    fault = pl.col("at_fault") if "at_fault" in counts else pl.lit(None, pl.Boolean)
    distance, duration = pl.col("distance").cast(pl.Float64), pl.col("duration_s")
    return pl.DataFrame(
        {"episode": numbers, **{name: value.numpy() for name, value in counts.items()}}
    ).select(
        pl.col("episode").cast(pl.Int64),
        pl.lit(seed, pl.Int64).alias("seed"),
        pl.coalesce(*ends, pl.lit(OTHER)).alias("reason"),
        pl.col(keys.SOFT_CRASH).cast(pl.Int64),
        (pl.col(keys.SOFT_CRASH) > 0).alias("had_soft_crash"),
        pl.col(keys.SOFT_CRASH_BEHIND).cast(pl.Int64),
        pl.col("reward", *terms),
        pl.col("decisions").cast(pl.Int64),
        duration,
        distance.alias("distance_m"),
        # Null for an episode that ended before it drove (off the road at once).
        pl.when(duration > 0).then(distance / duration).alias("mean_speed_mps"),
        pl.col("lane_changes").cast(pl.Int64),
        pl.when(pl.col("hard_crash")).then(fault).alias("at_fault"),
    )


def contact_side(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """What the ego overlaps, [N] int64, as a place in :data:`SIDES`.

    Two bodies meet along the axis on which their extents began to overlap last; the time since then
    is the depth of the overlap over the closing speed. Headings are small, so the axes are those of
    the road. Of several vehicles hit in one physics step the nearest to the front counts.
    """
    nobody = len(SIDES)
    first = torch.where(ego_overlaps(vehicles, road), _sides(vehicles, road), nobody).amin(-1)
    return torch.where(first == nobody, 0, first)


def ego_at_fault(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether the ego moved into somebody, [N] bool; false where it hit nobody.

    Along the road whoever is behind moves into the other, across it whoever is faster towards the
    other: a rule of geometry, no law. A driver that cuts in and is struck from behind is not at
    fault by it.
    """
    v = vehicles
    side, dy = _sides(v, road), v.y[:, 1:] - v.y[:, :1]
    across = v.speed * torch.sin(v.heading)
    pushes = torch.sign(dy) * across[:, :1] > -torch.sign(dy) * across[:, 1:]
    own = torch.where(side == _SIDE, pushes, side == _AHEAD)
    return (own & ego_overlaps(v, road)).any(-1)


def _sides(v: Vehicles, road: Road) -> Tensor:
    """On which side of the ego each of the others would have met it, [N, M - 1] int64."""
    dx, dy = road.distance_ahead(v.x[:, :1], v.x[:, 1:]), v.y[:, 1:] - v.y[:, :1]
    along, across = v.speed * torch.cos(v.heading), v.speed * torch.sin(v.heading)
    met_along = _time_since(
        dx, along[:, 1:] - along[:, :1], 0.5 * (v.length[:, 1:] + v.length[:, :1])
    )
    met_across = _time_since(
        dy, across[:, 1:] - across[:, :1], 0.5 * (v.width[:, 1:] + v.width[:, :1])
    )
    return torch.where(met_along < met_across, torch.where(dx > 0, _AHEAD, _BEHIND), _SIDE)


def _time_since(distance: Tensor, speed: Tensor, reach: Tensor) -> Tensor:
    """For how long (s) extents that touch at ``reach`` (m) overlap.

    Infinite where they do not close.
    """
    closing = -torch.sign(distance) * speed
    return torch.where(closing > 0, (reach - distance.abs()) / closing.clamp_min(1e-9), torch.inf)


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
def roll_out(
    env: EnvBase, policy: TensorDictModuleBase, episodes: Sequence[int], seed: int
) -> list[Rollout]:
    """Drive ``episodes`` side by side, with fewer or more rows.

    One rollout each, in the order given.
    """
    state = start_rows(env, episodes, seed)
    places = torch.arange(len(episodes), device=env.device)
    totals = torch.zeros(
        len(episodes), dtype=state.get(keys.VEHICLES).get("x").dtype, device=env.device
    )
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
            found[place] = _rollout(
                env, state[row : row + 1], episodes[place], actions, float(totals[place])
            )
        state, places = state[~done], places[~done]
    return [found[place] for place in range(len(episodes))]


def _rollout(
    env: EnvBase, after: TensorDictBase, episode: int, actions: tuple[int, ...], reward: float
) -> Rollout:
    """The rollout of the one row ``after``, which has just ended."""
    events, ego = after.get(keys.EVENTS), after.get(keys.EGO)
    end = next((name for name in keys.END_EVENTS if bool(events.get(name))), OTHER)
    side = contact_side(Vehicles.of(after.get(keys.VEHICLES)), road_in(after, base_of(env).road))
    contact, changing = (
        SIDES[int(side) if end == "hard_crash" else 0],
        bool(ego.get("change_direction") != 0),
    )
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
        padded = [
            [*actions[number], *[keys.KEEP] * (longest - len(actions[number]))]
            for number in sorted(actions)
        ]
        self.table = torch.tensor(padded, dtype=torch.int64)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        row = torch.searchsorted(self.episodes, tensordict.get(keys.EPISODE).cpu())
        decision = (
            tensordict.get(keys.EGO).get("decisions").cpu().clamp_max(self.table.shape[1] - 1)
        )
        action = self.table[row, decision]
        return tensordict.set(keys.ACTION, action.to(tensordict.get(keys.EPISODE).device))


def base_of(env: EnvBase) -> EnvBase:
    """The environment below the transforms."""
    return getattr(env, "base_env", env)


def step_rows(
    env: EnvBase, state: TensorDictBase, rows: Tensor, action: Tensor
) -> tuple[TensorDictBase, Tensor]:
    """The state after one decision from ``rows`` of ``state``, and the reward.

    As many at a time as ``env`` has.
    """
    count, size = action.shape[0], env.batch_size[0]
    states, rewards = [], []
    for start in range(0, count, size):
        # Filled up with the last row, so that all batches have one size: a network rounds alike in
        # all.
        batch = torch.arange(start, start + size, device=action.device).clamp_max(count - 1)
        after = env.step(state[rows[batch]].set(keys.ACTION, action[batch])).get("next")
        real = min(size, count - start)
        states.append(_decision_state(after)[:real])
        rewards.append(after.get(keys.REWARD)[:real, 0])
    return torch.cat(states), torch.cat(rewards)


def start_rows(env: EnvBase, episodes: Sequence[int], seed: int) -> TensorDictBase:
    """The first states of any number of episodes; :class:`UserError` for none."""
    size = env.batch_size[0]
    chunks = [episodes[start : start + size] for start in range(0, len(episodes), size)] or [[]]
    return torch.cat(
        [_decision_state(env.reset(start_of(env, chunk, seed)))[: len(chunk)] for chunk in chunks]
    )


def _decision_state(state: TensorDictBase) -> TensorDictBase:
    """What the next decision and step need."""
    return state.exclude(keys.REWARD, keys.REWARD_TERMS, keys.ACTION)
