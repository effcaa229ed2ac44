"""Driving given episodes: one row of facts about each.

The rows of a batch drive side by side. A row whose episode has ended takes the next one that has
not been driven yet, so none waits for the slowest. Once all have been handed out, the last ones
move to smaller batches.

The simulation is deterministic, so a driver's episode is the same again: by the kernel bit for bit
in any batch, and so is rule-driven traffic by the tensor code; generated traffic is so there in
batches of the same size (its network's matrix products round differently in others).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import polars as pl
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from ganlane import keys
from ganlane.errors import UserError
from ganlane.evaluation.measures import CRASHES, LEAST, crash_kinds, first_marks, marks_after
from ganlane.sim.state import STRAIGHT, Road, Vehicles, road_in

#: Decisions between two looks at which rows have ended. A look waits for the device and a reset
#: costs about a tenth of a decision; a row that has ended waits 3.5 decisions on average, of more
#: than 200 in an episode.
CHECK_EVERY = 8
#: A batch of at most so many rows is not made smaller: fewer are hardly faster.
SMALL_BATCH = 16
#: A batch is made smaller when at most this share of its rows still drives. To make one takes about
#: as long as 20 rows of generated traffic drive a decision.
LARGEST_SHARE = 0.9
#: The reason of an episode that something outside the environment ended (a user's own transform).
OTHER = "other"
#: What is read from the last state of an episode.
_LAST = (keys.EVENTS, keys.EGO, keys.STEP, keys.VEHICLES, keys.ROAD)


def run_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    episodes: Sequence[int],
    seed: int,
    on_progress: Callable[[int, int], None] | None = None,
    make_smaller: Callable[[int], EnvBase] | None = None,
) -> pl.DataFrame:
    """Drive exactly ``episodes`` of ``seed``, each to its own end; one row each, in that order.

    Which episodes are counted does not depend on how long any of them takes, so short ones are not
    favoured. The numbers are the same in any batch, by the tensor code with generated traffic up to
    rounding. The policy acts deterministically.

    Args:
        env: batched environment, batch size ``[N]``, whose ``reset`` takes ``seed`` and ``episode``
            in the tensordict, and as an argument ``next_episode`` [N], which the rows of a
            ``_reset`` mask start (:class:`ganlane.env.HighwayEnv` and what is built around it).
        policy: writes ``action``; reads the observation or the raw state.
        episodes: their numbers.
        on_progress: called now and then with (episodes finished, episodes in all).
        make_smaller: makes ``env`` with fewer rows; the last episodes move there when at most
            :data:`LARGEST_SHARE` of the rows are still driving. Not used where something is held
            per row: by traffic with ``rows_must_stay``, and by every policy without
            ``rows_must_stay = False``.

    Returns:
        Columns ``episode, seed, reason`` (:data:`ganlane.keys.END_EVENTS`, or ``other``),
        ``soft_crash`` and ``soft_crash_behind`` (onsets), ``had_soft_crash``, ``reward``
        (undiscounted return), ``reward_*`` (each term's sum), ``decisions``, ``duration_s``,
        ``distance_m``, ``mean_speed_mps`` (distance over time), ``lane_changes``; of a hard crash,
        else null, ``crash`` (:data:`ganlane.evaluation.measures.CRASHES`) and ``at_fault``, whether
        it is the first of them; ``least_ttc_s``, ``least_headway_s``, ``hardest_braking_mps2`` and
        ``rms_acceleration_mps2`` (at the ends of decisions).

    Raises:
        UserError: no episodes are asked for, the environment is not batched in one dimension, or
            its reset ignores ``next_episode``.
    """
    if len(env.batch_size) != 1:
        shape = list(env.batch_size)
        raise UserError(
            f"env: batch size {shape} was found, expected [N]; build the environment with N rows."
        )

    numbers = list(episodes)
    # Noisy layers and epsilon-greedy stay off: a table is about the learnt policy.
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        evaluation = _Evaluation(env, policy, numbers, seed, make_smaller)
        driven = evaluation.run(on_progress)

    return _episode_rows(driven, numbers, seed, evaluation.road)


def start_of(env: EnvBase, numbers: Sequence[int], seed: int) -> TensorDict:
    """The tensordict that makes ``env.reset`` start these episodes.

    Args:
        env: batched environment, batch size ``[N]``.
        numbers: of the episodes, from 1 to N; the last one also fills the rows left over.
        seed: of all of them.

    Raises:
        UserError: there are no numbers.
    """
    if len(numbers) == 0:
        raise UserError(
            "episodes: none were asked for; expected at least one, give for instance episodes=100."
        )
    rows = env.batch_size[0]
    spare = rows - len(numbers)
    padded = [*numbers, *[numbers[-1]] * spare]
    episode = torch.tensor(padded, dtype=torch.int64, device=env.device)
    counters = {
        keys.SEED: torch.full_like(episode, seed),
        keys.EPISODE: episode,
    }
    return TensorDict(counters, [rows], device=env.device)


class _Evaluation:
    """Episodes on their way through the rows of an environment.

    Arguments as in :func:`run_episodes`.

    Attributes:
        total: E, the number of episodes.
        handed_out: how many of them a row has begun.
        finished: what the episodes gave that have ended, on the CPU, in the order of their ends.
        state: where the rows are, [N].
        driving: rows [N] bool whose episode counts and has not ended.
        rows: of each row ``place``, ``marks``, ``sums`` and ``last``.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        numbers: list[int],
        seed: int,
        make_smaller: Callable[[int], EnvBase] | None,
    ) -> None:
        self.env = env
        self.policy = policy
        self.total = len(numbers)

        # Who holds something per row outside the tensordict, a foreign simulator for instance,
        # loses it when rows move; a policy has to say that it does not.
        traffic = getattr(env, "traffic", None)
        rows_stay = getattr(traffic, "rows_must_stay", False)
        may_move = not (rows_stay or getattr(policy, "rows_must_stay", True))
        self.make_smaller = make_smaller if may_move else None

        # What holds something per row outside the tensordict might not stand being driven on after
        # an end.
        self.check_every = 1 if rows_stay else CHECK_EVERY

        rows = env.batch_size[0]
        self.numbers = torch.tensor(numbers, dtype=torch.int64, device=env.device)
        # Of each row where its episode stands in the list (the list's length in spare rows) and
        # what is marked; from the first decision on also the sums over the decisions of its
        # episode, and the last state of it.
        place = torch.arange(rows, device=env.device).clamp_max(self.total)
        beginning = {"place": place, "marks": first_marks(place)}
        self.rows = TensorDict(beginning, [rows])

        # Rows beyond the list are spare from the start.
        self.driving = place < self.total
        self.handed_out = min(rows, self.total)
        self.finished: list[TensorDictBase] = []

        self.state: TensorDictBase = env.reset(start_of(env, numbers[:rows], seed))
        self.road = getattr(env, "road", STRAIGHT)

    def run(self, on_progress: Callable[[int, int], None] | None) -> TensorDictBase:
        """Drive all episodes to their ends.

        Returns:
            ``sums`` over the decisions of each episode, its ``last`` state, and its ``marks``, each
            [E], in the order of the episodes, on the CPU.
        """
        # Decisions are driven in stretches; between two of them rows are collected and handed out.
        # To look more often would cost more than the rows that wait.
        done = 0
        while done < self.total:
            for _ in range(self.check_every):
                self._decide()

            done += self._collect()
            if on_progress is not None:
                on_progress(done, self.total)
            if done < self.total:
                self._go_on()

        # Episodes end in any order.
        driven: TensorDictBase = torch.cat(self.finished)  # type: ignore[assignment, arg-type]
        return driven[driven["place"].argsort()]

    def _decide(self) -> None:
        """Drive one decision and count it.

        Nothing is read back from the device, so this never waits.
        """
        # The policy writes its action into the tensordict that it reads.
        after = self.env.step(self.policy(self.state))
        reached = after["next"]
        added = _added(reached)
        last = reached.select(*_LAST, strict=False)

        # Which sums there are depends on the environment's reward, which the first step shows.
        before = self.rows
        if "sums" not in before:
            before.update({"sums": added.apply(torch.zeros_like), "last": last})

        counted = {
            "place": before["place"],
            "marks": marks_after(reached, before["marks"], self.road),
            "sums": before["sums"] + added,
            "last": last,
        }

        # Rows whose episode has ended keep what they had.
        self.rows = TensorDict(counted, before.batch_size).where(self.driving, before)

        # From its first end on a row counts no more, whatever it drives.
        self.driving = self.driving & ~reached["done"].squeeze(-1)
        self.state = step_mdp(after)

    def _collect(self) -> int:
        """Put aside what the episodes that have ended gave; how many there were.

        Their rows are spare then.
        """
        # A row is counted until its first end, even where it is driven on until the next look.
        counting = self.rows["place"] < self.total
        ended = (counting & ~self.driving).nonzero()[:, 0]
        if len(ended) > 0:
            # On the CPU, so that the device holds no more than a batch.
            self.finished.append(self.rows[ended].cpu())
            self.rows["place"][ended] = self.total
        return len(ended)

    def _go_on(self) -> None:
        """Give spare rows the next episodes.

        Without any, start the last ones again or leave such rows out.

        Raises:
            UserError: the environment's reset ignores ``next_episode``.
        """
        driving = self.driving.nonzero()[:, 0]
        rows = self.env.batch_size[0]

        # Nothing is left to hand out, and rows are spare: a smaller batch is faster.
        wide = rows > SMALL_BATCH and len(driving) <= LARGEST_SHARE * rows
        if wide and self.handed_out == self.total and self.make_smaller is not None:
            self.env = self.make_smaller(len(driving))
            # Everything that is held per row goes along.
            for name in ("state", "rows", "driving"):
                setattr(self, name, getattr(self, name)[driving])
            return

        # Spare rows take the next numbers of the list, in order.
        waiting = self.total - self.handed_out
        new = (~self.driving).nonzero()[:waiting, 0]
        place = self.rows["place"]
        place[new] = torch.arange(len(new), device=place.device) + self.handed_out
        self.handed_out += len(new)
        self.driving[new] = True

        # The sums of a row begin anew with its episode.
        for total in self.rows["sums"].values():
            total[new] = 0.0
        self.rows["marks"][new] = first_marks(new)

        # Spare rows that have ended start theirs again, uncounted: an environment drives all of its
        # rows, and from an end none should be driven on.
        mask = self.state["done"] & (place == self.total)[:, None]
        mask[new] = True
        if not bool(mask.any()):
            return

        # Whose place is beyond the list stays with the number that it had.
        number = self.numbers[place.clamp_max(self.total - 1)]
        wanted = torch.where(place < self.total, number, self.state[keys.EPISODE])
        self.state = self.env.reset(self.state.set("_reset", mask), next_episode=wanted)

        # An environment that goes on with numbers of its own would fill the table with episodes
        # that nobody asked for.
        if not torch.equal(self.state[keys.EPISODE], wanted):
            raise UserError(
                "env: its reset did not start the episodes that it was given; take next_episode "
                "[N] in _reset and start it in the rows of the _reset mask, as "
                "ganlane.env.HighwayEnv does."
            )


def _added(state: TensorDictBase) -> TensorDict:
    """What one decision, which led to ``state`` [N], adds to the sums of its episode.

    The reward and each of its terms, onsets of soft crashes, and the square of the mean
    acceleration, (m/s2)^2; each [N].
    """
    values = {"reward": state[keys.REWARD]}
    for name, term in state.get(keys.REWARD_TERMS, {}).items():
        values[f"reward_{name}"] = term
    for name in (keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND):
        values[name] = state[keys.EVENTS, name]
    values["squared_acceleration"] = state[keys.EGO, "mean_acceleration"].double().square()

    # Double precision: thousands of small rewards are summed.
    rows = state.batch_size
    doubles = {name: value.reshape(rows).double() for name, value in values.items()}
    return TensorDict(doubles, rows)


def _episode_rows(
    driven: TensorDictBase, numbers: list[int], seed: int, road: Road
) -> pl.DataFrame:
    """What :func:`run_episodes` returns.

    Args:
        driven: of :meth:`_Evaluation.run`, [E].
        numbers: of the episodes.
        seed: of all of them.
        road: where the states say nothing of theirs.
    """
    last = driven["last"]
    ego = last[keys.EGO]
    marks = driven["marks"]

    # One column per count, each [E].
    columns = dict(driven["sums"].items())
    for name in keys.END_EVENTS:
        columns[name] = last[keys.EVENTS, name].squeeze(-1)
    # What the ego counts itself since its episode began.
    for name in ("distance", "lane_changes", "decisions"):
        columns[name] = ego[name]
    columns["duration_s"] = last[keys.STEP].double() * keys.PHYSICS_STEP_S
    columns |= dict(marks.items())

    # A state without vehicles tells nothing about a crash.
    kinds: list[str | None] = [None] * len(numbers)
    if keys.VEHICLES in last:
        vehicles = Vehicles.of(last[keys.VEHICLES])
        since_s = columns["duration_s"] - marks["change_s"]
        kinds[:] = crash_kinds(vehicles, since_s, road_in(last, road))
    # Every row has a kind, as if it had crashed.
    crash = pl.when("hard_crash").then(pl.Series("crash", kinds, pl.String))

    # The reward's terms are the environment's own, so their names are not known here.
    terms = [name for name in columns if name.startswith("reward_")]
    # The first event that happened is the reason.
    ends = [pl.when(pl.col(event)).then(pl.lit(event)) for event in keys.END_EVENTS]
    distance = pl.col("distance").cast(pl.Float64)
    duration = pl.col("duration_s")
    mean_square = pl.col("squared_acceleration") / pl.col("decisions")

    table = pl.DataFrame({name: value.numpy() for name, value in columns.items()})
    return table.select(
        pl.Series("episode", numbers, pl.Int64),
        pl.lit(seed, pl.Int64).alias("seed"),
        pl.coalesce(*ends, pl.lit(OTHER)).alias("reason"),
        pl.col(keys.SOFT_CRASH).cast(pl.Int64),
        # Onsets are counted; the paper asks whether there was one.
        (pl.col(keys.SOFT_CRASH) > 0).alias("had_soft_crash"),
        pl.col(keys.SOFT_CRASH_BEHIND).cast(pl.Int64),
        "reward",
        *terms,
        pl.col("decisions").cast(pl.Int64),
        duration,
        distance.alias("distance_m"),
        # Null for an episode that ended before it drove (off the road at once).
        pl.when(duration > 0).then(distance / duration).alias("mean_speed_mps"),
        pl.col("lane_changes").cast(pl.Int64),
        (crash == CRASHES[0]).alias("at_fault"),
        crash,
        *LEAST,
        rms_acceleration_mps2=mean_square.sqrt(),
    )
