"""Running given episodes with a policy, and one row of facts about each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import polars as pl
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ganlane import keys
from ganlane.errors import UserError
from ganlane.evaluation.tally import EpisodeTally

#: Told after every look at the rows: (episodes finished, episodes in all).
Progress = Callable[[int, int], None]
#: Decisions between two looks at whether all rows have finished; each look waits for the device once.
CHECK_EVERY = 8
#: The reason of an episode that something outside the environment ended (a user's own transform).
OTHER = "other"


def run_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    episodes: Sequence[int],
    seed: int,
    on_progress: Progress | None = None,
) -> pl.DataFrame:
    """Drive exactly ``episodes`` of ``seed``; one row per episode, in the order given.

    They run in chunks of the environment's batch size; a row that finishes first is ignored until the chunk
    is done, so long episodes are not under-represented. The policy acts deterministically, without gradients.

    Args:
        env: batched environment, batch size ``[N]``, whose ``reset`` takes ``seed`` and ``episode``.
        policy: writes ``action``; reads the observation or the raw state.
        episodes: episode numbers, for instance ``range(1000)``.
        seed: the seed of all of them.
        on_progress: called now and then with (episodes finished, episodes in all).

    Returns:
        Columns ``episode, seed, reason`` (``goal``, ``hard_crash``, ``out_of_road``, ``timeout``,
        ``scene_end``; ``other`` if none of these ended it), ``soft_crash`` (onsets), ``had_soft_crash``,
        ``soft_crash_behind`` (onsets), ``reward`` (undiscounted return), ``reward_*`` (each term's sum),
        ``decisions``, ``duration_s``, ``distance_m``, ``mean_speed_mps`` (distance over time),
        ``lane_changes``.

    Raises:
        UserError: no episodes are asked for, or the environment is not batched in one dimension.
    """
    if len(episodes) == 0:
        raise UserError("episodes: none were asked for; expected at least one, give for instance episodes=100.")
    if len(env.batch_size) != 1:
        shape = list(env.batch_size)
        raise UserError(f"env: batch size {shape} was found, expected [N]; build the environment with N rows.")
    frames = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for start, chunk in _chunks(episodes, env.batch_size[0]):
            report = _progress_of_chunk(on_progress, start, len(episodes))
            frames.append(_run_chunk(env, policy, chunk, seed, report))
    return pl.concat(frames)


def _chunks(episodes: Sequence[int], size: int) -> Iterator[tuple[int, list[int]]]:
    """(position, numbers) of each run of at most ``size`` episodes."""
    for start in range(0, len(episodes), size):
        yield start, list(episodes[start : start + size])


def _progress_of_chunk(on_progress: Progress | None, before: int, total: int) -> Callable[[int], None]:
    """A function that reports a chunk's finished episodes on top of those finished ``before`` it."""

    def report(finished: int) -> None:
        if on_progress is not None:
            on_progress(before + finished, total)

    return report


def start_of(env: EnvBase, numbers: Sequence[int], seed: int) -> TensorDict:
    """The tensordict that makes ``env.reset`` start these episodes; the last one also fills the rows left over."""
    rows = env.batch_size[0]
    padded = list(numbers) + [numbers[-1]] * (rows - len(numbers))
    episode = torch.tensor(padded, dtype=torch.int64, device=env.device)
    return TensorDict({keys.SEED: torch.full_like(episode, seed), keys.EPISODE: episode}, [rows], device=env.device)


def _run_chunk(
    env: EnvBase, policy: TensorDictModuleBase, numbers: list[int], seed: int, report: Callable[[int], None]
) -> pl.DataFrame:
    """Run at most N episodes to their ends."""
    state: TensorDictBase = env.reset(start_of(env, numbers, seed))
    tally = EpisodeTally(torch.arange(env.batch_size[0], device=env.device) < len(numbers))
    driving = len(numbers)
    while driving > 0:
        for _ in range(CHECK_EVERY):
            stepped, state = env.step_and_maybe_reset(policy(state))
            tally.add(stepped["next"])
        driving = int(tally.driving.sum())
        report(len(numbers) - driving)
    return _episode_rows(tally.measures(), numbers, seed)


def _episode_rows(measures: dict[str, Tensor], numbers: list[int], seed: int) -> pl.DataFrame:
    """The rows of a chunk from its tally (see :func:`run_episodes` for the columns)."""
    counts = {name: value[: len(numbers)].numpy() for name, value in measures.items()}
    terms = [name for name in counts if name.startswith("reward_")]
    integer = pl.Int64
    frame = pl.DataFrame({"episode": numbers, **counts})
    return frame.select(
        pl.col("episode").cast(integer),
        pl.lit(seed, integer).alias("seed"),
        pl.coalesce(*(_named_where_true(name) for name in keys.END_EVENTS), pl.lit(OTHER)).alias("reason"),
        pl.col(keys.SOFT_CRASH).cast(integer),
        (pl.col(keys.SOFT_CRASH) > 0).alias("had_soft_crash"),
        pl.col(keys.SOFT_CRASH_BEHIND).cast(integer),
        pl.col("reward", *terms),
        pl.col("decisions").cast(integer),
        pl.col("duration_s"),
        pl.col("distance").cast(pl.Float64).alias("distance_m"),
        _mean_speed().alias("mean_speed_mps"),
        pl.col("lane_changes").cast(integer),
    )


def _mean_speed() -> pl.Expr:
    """Distance over time, m/s; null for an episode that ended before it drove (off the road at once)."""
    speed = pl.col("distance").cast(pl.Float64) / pl.col("duration_s")
    return pl.when(pl.col("duration_s") > 0).then(speed)


def _named_where_true(event: str) -> pl.Expr:
    """The event's name where it happened, null elsewhere."""
    return pl.when(pl.col(event)).then(pl.lit(event))
