"""A batch of highways as a ``gymnasium.vector.VectorEnv``, stepped together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ganlane import keys
from ganlane.arguments import seed_number, whole_number
from ganlane.errors import UserError
from ganlane.gym.base import OnRows, make_rows
from ganlane.gym.rows import SEEDS, Flags, Floats, actions_of, array_of, reset_options


class HighwayVectorGym(OnRows, VectorEnv[Floats, npt.NDArray[Any], npt.NDArray[Any]]):
    """``gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, ...)``.

    Args:
        num_envs: N, highways side by side.
        traffic: as in :func:`ganlane.api.make_env`, as are ``options``.
        seed: of the first episodes, until ``reset(seed=...)`` gives another; None: drawn at random.
        render_mode: None or ``rgb_array``.
        autoreset_mode: what happens to a row that has ended, see below.
        max_episode_steps: passed by ``make_vec`` for a spec of this environment; ``timeout_s`` sets
            the limit.
        options: as in :class:`ganlane.gym.single.HighwayGym`.

    ``AutoresetMode.SAME_STEP``: a row that ends is reset in the same step: ``observation`` is the
    first of its next episode, ``info["final_obs"]`` and ``info["final_info"]`` are the last of the
    old one. ``NEXT_STEP``: it is reset in the next step, which ignores its action and gives the
    reward 0. ``DISABLED``: you reset it by ``reset(options={"reset_mask": mask})``, which begins
    the next episodes in the rows of a boolean array [N].

    Row i of N runs the episodes i, i + N, i + 2N, ... of the seed.
    ``reset(options={"episode": k})`` begins with the episodes k + i instead; an array [N] sets the
    episode of every row.

    Raises:
        UserError: a wrong value.
    """

    metadata = {  # noqa: RUF012 - gymnasium's own form
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array"],
        "render_fps": 1,
    }

    def __init__(
        self,
        num_envs: int = 1,
        traffic: Any = "idm_mobil",
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        transforms: Sequence[Any] = (),
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(
                f"render_mode={render_mode}: a batch has rgb_array only; "
                "use gymnasium.make for a window."
            )
        self._mode = _mode_of(autoreset_mode)
        self._rows = make_rows(
            traffic,
            num_envs,
            pictures=render_mode is not None,
            transforms=transforms,
            keys=options,
        )
        self.num_envs = self._rows.count
        self.render_mode = render_mode

        episode = self._rows.episode
        if max_episode_steps is not None:
            limit = whole_number("max_episode_steps", max_episode_steps, 1, 2**31)
            # make_vec() passes the limit of the specification; a batch cannot end episodes earlier.
            if limit < episode.most_decisions():
                raise UserError(
                    f"max_episode_steps={limit}: a batch has its own time limit; "
                    f"give timeout_s={limit * episode.decision_period_s:g}."
                )

        # A picture per decision.
        fps = max(1, round(1.0 / episode.decision_period_s))
        self.metadata = {
            **self.metadata,
            "autoreset_mode": self._mode,
            "render_fps": fps,
        }

        self.single_observation_space = self._rows.space
        self.single_action_space = self._rows.action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        self._seed = None if seed is None else seed_number(seed)
        #: Rows whose episode is over, until they are reset.
        self._ended = np.zeros(self.num_envs, dtype=np.bool_)

        self._view: Any = None
        if render_mode is not None:
            from ganlane.gym.rendering import BatchView  # with torch, which takes seconds

            self._view = BatchView(self._rows)  # type: ignore[arg-type]

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin episodes in all rows, or with ``reset_mask`` in some; see the class for which.

        Args:
            seed: one for all rows, or N of them; None: that of the constructor at first, and then
                each row goes on with its next episode.
            options: ``episode``, one number from 0 or N of them, or ``reset_mask``, bool [N].

        Returns:
            Observations [N, D] and info, both the caller's to keep.

        Raises:
            UserError: a wrong value, or a mask before the first reset or beside a seed or episode.
        """
        chosen = reset_options(options, ("episode", "reset_mask"))
        if "reset_mask" in chosen:
            if seed is not None or "episode" in chosen:
                raise UserError(
                    "reset(): with reset_mask each of its rows begins its next episode; leave out "
                    "seed and episode, or reset all rows."
                )
            fresh = array_of(chosen["reset_mask"])
            if fresh.shape != (self.num_envs,) or fresh.dtype != np.bool_:
                raise UserError(
                    f"options: reset_mask: expected a boolean array of shape ({self.num_envs},); "
                    "give one flag for every row."
                )
            self._rows.check_started()
            self._rows.restart(fresh)
        else:
            fresh = np.ones(self.num_envs, dtype=np.bool_)
            self._start(seed, chosen.get("episode"))
        self._begun(fresh)

        # Copies: the arrays of the rows are overwritten by the next step.
        return self._rows.observation().copy(), _copied(self._rows.info())

    def _begun(self, fresh: Flags) -> None:
        """New episodes have begun in the rows where ``fresh`` [N] is true."""
        self._ended = self._ended & ~fresh
        if self._view is not None:
            self._view.start(fresh)

    def _start(self, seed: int | Sequence[int] | None, episode: Any) -> None:
        """Begin the episodes that the arguments of a reset name, or the next ones, in all rows."""
        # Row i begins with episode i and adds N each time, so no two rows drive the same one.
        rows = np.arange(self.num_envs)
        first = rows

        # A seed starts with its first episodes; without one every row goes on with its next.
        seeds: Any = self._seed
        if seed is not None:
            seeds = [seed_number(one) for one in array_of(seed).ravel().tolist()]
            # gymnasium seeds np_random here, from which unseeded environments draw. It takes one.
            super().reset(seed=seeds[0] if len(seeds) == 1 else None)
        elif self._rows.started:
            # A copy: the state's own array is overwritten by the start.
            seeds = self._rows.array(keys.SEED).copy()
            first = self._rows.array(keys.EPISODE) + self.num_envs
        elif seeds is None:
            seeds = int(self.np_random.integers(SEEDS))

        if episode is not None:
            first = array_of(episode)
            whole = first.dtype.kind in "iu"
            # Cast first: an unsigned number too large for int64 is below 0 then. What is not whole
            # is refused as a number below 0 is.
            first = first.astype(np.int64) if whole else np.asarray(-1)
            if (first < 0).any():
                raise UserError(
                    f"options: episode={episode!r:.80}: expected whole numbers from 0; "
                    "give for instance 3."
                )
            # One number k for all means the episodes k, k + 1, ...
            if first.ndim == 0:
                first = first + rows

        # One seed for all rows, or one for each.
        if first.shape != (self.num_envs,) or np.size(seeds) not in (1, self.num_envs):
            raise UserError(
                f"reset(): expected one seed and one episode, or {self.num_envs} of each."
            )
        if np.size(seeds) == 1:
            seeds = np.ravel(seeds)[0]
        self._rows.start(seeds, first)

    def step(self, actions: Any) -> tuple[Floats, npt.NDArray[Any], Flags, Flags, dict[str, Any]]:
        """One decision in every row: observations [N, D], rewards and ends [N], info.

        Args:
            actions: numbers of actions [N], or controls [N, 2] from -1 to 1.

        Returns:
            ``(observations, rewards, terminated, truncated, info)``, rewards in float64 and ends as
            bool, all the caller's to keep. The class says what a row gives whose episode ends.

        Raises:
            UserError: wrong actions, no reset before, or with ``DISABLED`` a row that is over.
        """
        self._rows.check_started()

        # Rows that ended one step ago, with NEXT_STEP and DISABLED. With SAME_STEP no row waits.
        same_step = self._mode is AutoresetMode.SAME_STEP
        waiting = self._ended
        waits = not same_step and waiting.any()
        if waits and self._mode is AutoresetMode.DISABLED:
            raise UserError(
                f"step(): the episodes of rows {np.flatnonzero(waiting).tolist()} are over; call "
                "reset(options={'reset_mask': mask}) first, or choose another autoreset_mode."
            )

        # The arrays of the rows are overwritten by their next call; what callers get are copies.
        commanded = actions_of(actions, self.num_envs, self._rows.actions)
        stepped = self._rows.step(commanded)
        reward = stepped.reward.astype(np.float64)
        terminated = stepped.terminated.copy()
        truncated = stepped.truncated.copy()

        if self._view is not None:
            # Pictures name the numbered actions.
            numbers = commanded if self._rows.actions.names else -1
            self._view.after_step(numbers, reward)

        # NEXT_STEP: these rows ended one step ago. They were stepped with the others, which is
        # discarded here.
        if waits:
            for result in (reward, terminated, truncated):
                result[waiting] = 0
            self._rows.restart(waiting)
            self._begun(waiting)

        ended = terminated | truncated
        self._ended = ended

        # SAME_STEP: the last observation and info go into the info, before the rows are reset.
        final: dict[str, Any] = {}
        if same_step and ended.any():
            final = {
                "final_obs": _where(ended, self._rows.observation()),
                "_final_obs": ended,
                "final_info": _copied(self._rows.info()),
                "_final_info": ended,
            }
            self._rows.restart(ended)
            self._begun(ended)

        observation = self._rows.observation().copy()
        info = _copied(self._rows.info())
        return observation, reward, terminated, truncated, info | final

    def action_masks(self) -> Flags:
        """Which actions are allowed now, bool [N, A]."""
        return self._rows.mask().copy()

    def render(self) -> tuple[Any, ...] | None:
        """A picture [height, width, 3] uint8 of every row, without trails."""
        if self._view is None:
            raise UserError(
                "render(): made without render_mode; give render_mode='rgb_array' to make_vec()."
            )
        self._rows.check_started()
        return self._view.pictures()


def _mode_of(mode: AutoresetMode | str) -> AutoresetMode:
    """gymnasium's mode, given as such, by its name or by its value."""
    choices = {choice.name.lower(): choice for choice in AutoresetMode}
    text = str(mode).lower()
    for name, choice in choices.items():
        if mode is choice or text in (name, choice.value.lower()):
            return choice

    raise UserError(
        f"autoreset_mode={mode}: expected one of {', '.join(choices)}; choose one of them."
    )


def _where(rows: Flags, observations: Floats) -> npt.NDArray[np.object_]:
    """Final observations in gymnasium's form: an object array [N], None outside ``rows``."""
    # gymnasium's form: rows that go on have none, which is what an empty array of objects holds.
    final = np.empty(len(rows), dtype=object)
    for row in rows.nonzero()[0].tolist():
        final[row] = observations[row].copy()
    return final


def _copied(info: dict[str, Any]) -> dict[str, Any]:
    """A copy of an info, which the caller may keep."""
    # The terms of the reward are a dictionary, whose copy() has the same arrays: they are copied
    # once more below. To test every value for it took a quarter of this function's time.
    terms = info[keys.REWARD_TERMS]
    copy = {name: value.copy() for name, value in info.items()}
    copy[keys.REWARD_TERMS] = {name: term.copy() for name, term in terms.items()}
    return copy
