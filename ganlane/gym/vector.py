"""A batch of highways as a ``gymnasium.vector.VectorEnv``: stepped together as tensors, not one by one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ganlane.api import make_env
from ganlane.env.checks import seed_number
from ganlane.errors import UserError
from ganlane.gym.rendering import BatchView, real_time_fps
from ganlane.gym.rows import (
    ACTIONS,
    SEEDS,
    Floats,
    Rows,
    actions_of,
    episode_numbers,
    known_options,
    row_mask,
)
from ganlane.options import Option, option

Flags = npt.NDArray[np.bool_]


class HighwayVectorGym(VectorEnv[Floats, npt.NDArray[np.int64], npt.NDArray[Any]]):
    """``gymnasium.make_vec("ganlane/Highway-v0", num_envs=64, ...)``.

    Args:
        num_envs: N, highways side by side.
        traffic: as in :func:`ganlane.api.make_env`, as are ``options``.
        seed: of the first episodes, until ``reset(seed=...)`` gives another; None: drawn at random.
        render_mode: None or ``rgb_array``.
        options: as in :class:`ganlane.gym.single.HighwayGym`.

    A row that ends is reset in the same step (``AutoresetMode.SAME_STEP``): ``observation`` is the first of its next
    episode, ``info["final_obs"]`` and ``info["final_info"]`` hold what it ended with. Row i of N runs the episodes
    i, i + N, i + 2N, ... of the seed, in whatever batch. ``reset(options={"episode": k})`` begins with the episodes
    k + i instead; an array [N] gives each row its own. ``reset(options={"reset_mask": mask})`` sends the rows of a
    boolean array [N] on to their next episodes.

    Raises:
        UserError: a wrong value.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        traffic: Option = "idm_mobil",
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(
                f"render_mode={render_mode}: a batch has rgb_array only; use gymnasium.make for a window."
            )
        made = make_env(traffic, num_envs, **options)
        self._rows = Rows(made)
        self.num_envs, self.render_mode = self._rows.count, render_mode
        self.metadata = {**self.metadata, "render_fps": real_time_fps(made)}
        self.single_observation_space, self.single_action_space = self._rows.space, Discrete(ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._seed = None if seed is None else seed_number(seed)
        self._view = None if render_mode is None else BatchView(made, option("traffic", traffic).label())

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin episodes in all rows, or with ``reset_mask`` in some; see the class for which."""
        given = known_options(options, ("episode", "reset_mask"))
        if "reset_mask" in given:
            fresh = row_mask(given["reset_mask"], self.num_envs)
            self._rows.restart(fresh)
        else:
            fresh = np.ones(self.num_envs, dtype=np.bool_)
            self._start(seed, given.get("episode"))
        if self._view is not None:
            self._view.start(fresh)
        return self._rows.observation(), self._rows.info()

    def _start(self, seed: int | Sequence[int] | None, episode: Any) -> None:
        each = np.arange(self.num_envs)
        if seed is not None:
            super().reset(seed=seed if isinstance(seed, int) else None)
            seeds: Any = [seed_number(one) for one in np.atleast_1d(seed).tolist()]
            first = each
        else:
            seeds, first = self._next(each)
        if episode is not None:
            first = episode_numbers(episode)
            first = first + each if first.ndim == 0 else first
        if first.shape != (self.num_envs,) or np.size(seeds) not in (1, self.num_envs):
            raise UserError(f"reset(): expected one seed and one episode, or {self.num_envs} of each.")
        self._rows.start(seeds if np.size(seeds) > 1 else np.ravel(seeds)[0], first)

    def _next(self, each: npt.NDArray[np.int64]) -> tuple[Any, npt.NDArray[np.int64]]:
        """Seeds and episodes after the present ones; at first the constructor's seed and the first episodes."""
        if self._rows.state is not None:
            now = self._rows.info()
            return now["seed"], now["episode_number"] + self.num_envs
        return int(self.np_random.integers(SEEDS)) if self._seed is None else self._seed, each

    def step(self, actions: Any) -> tuple[Floats, npt.NDArray[Any], Flags, Flags, dict[str, Any]]:
        """One decision in every row: observations [N, D], rewards, terminated, truncated [N], info."""
        after = self._rows.step_and_reset(actions_of(actions, self.num_envs))
        reward, terminated, truncated = (
            after.get(name)[:, 0].cpu().numpy().copy() for name in ("reward", "terminated", "truncated")
        )
        info, ended = self._rows.info(), terminated | truncated
        if self._view is not None:
            self._view.after_step(actions, reward)
            self._view.start(ended)
        if ended.any():
            final = self._rows.observation(after)
            info |= {"final_obs": _where(ended, final), "_final_obs": ended.copy()}
            info |= {"final_info": self._rows.info(after), "_final_info": ended.copy()}
        return self._rows.observation(), reward.astype(np.float64), terminated, truncated, info

    def action_masks(self) -> Flags:
        """Which actions are allowed now, bool [N, 3]."""
        return self._rows.allowed()

    def render(self) -> tuple[Any, ...] | None:
        """A picture [height, width, 3] uint8 of every row, without trails."""
        if self._view is None:
            raise UserError("render(): made without render_mode; give render_mode='rgb_array' to make_vec().")
        return self._view.pictures(self._rows.now())


def _where(rows: Flags, observations: Floats) -> npt.NDArray[np.object_]:
    """Final observations in gymnasium's form: an object array [N], None outside ``rows``."""
    found = np.full(len(rows), None, dtype=object)
    for row in np.flatnonzero(rows):
        found[row] = observations[row]
    return found
