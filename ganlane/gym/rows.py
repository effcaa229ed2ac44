"""Basis of the single and the vector environment: N highways behind NumPy arrays, and checks of arguments.

:class:`Rows` is the interface. :mod:`~ganlane.gym.native_rows` implements it for rule-driven traffic, by the native
kernel and without torch; :mod:`~ganlane.gym.tensor_rows` for everything else, by the TorchRL environment.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box

from ganlane.errors import UserError
from ganlane.keys import ACTIONS
from ganlane.native.batch import SPEED_RATIO_LIMIT, Stepped
from ganlane.native.library import why_not
from ganlane.options import Option
from ganlane.parameters.episode import EpisodeParameters

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
#: Exclusive upper bound of the seeds that unseeded environments draw.
SEEDS: Final = 2**31


class Rows(ABC):
    """N highways.

    Attributes:
        count: N.
        space: of one observation.
        episode: decision period and time limit.
        env, state: the TorchRL environment and the state of its rows; None with the native kernel.
    """

    count: int
    space: Box
    episode: EpisodeParameters
    env: Any = None
    state: Any = None

    @abstractmethod
    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        """Begin the episodes [N] of the seeds [N]; each may be one number for all rows."""

    @abstractmethod
    def restart(self, rows: Flags) -> None:
        """Begin the next episode, number n + N after n, in the rows where ``rows`` [N] is true."""

    @abstractmethod
    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        """One decision in every row; no row is reset. The arrays are valid until the next call."""

    @abstractmethod
    def observation(self) -> Floats:
        """Observations [N, D], within the space; valid until the next call."""

    @abstractmethod
    def mask(self) -> Flags:
        """Allowed actions [N, 3]: the mask's, without one those that stay on the road; valid until the next call."""

    @abstractmethod
    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
        """Present seeds and episodes [N]; None before the first :meth:`start`."""

    def check_started(self) -> None:
        """Raise :class:`UserError` before the first :meth:`start`."""
        if self.numbers() is None:
            raise UserError("no episode is under way; call reset() first.")

    @abstractmethod
    def info(self) -> dict[str, Any]:
        """Gymnasium's info (docs/gymnasium.md) as arrays [N] by name; valid until the next call."""


def make_rows(traffic: Option, count: int, render_mode: str | None, options: Mapping[str, Any]) -> Rows:
    """N highways with ``traffic`` and the ``options`` of :func:`ganlane.api.make_env`.

    The native kernel drives them where it can, unless the option ``kernel`` is ``torch`` or there is a
    ``render_mode``, since the kernel shows no physics steps.

    Raises:
        UserError: a wrong value.
    """
    if render_mode is None and why_not() is None:
        from ganlane.gym.native_rows import native_rows  # Hydra's config classes take a tenth of a second

        rows = native_rows(traffic, count, dict(options))
        if rows is not None:
            return rows
    from ganlane.gym.tensor_rows import TensorRows  # torch takes seconds

    return TensorRows(traffic, count, options)


def observation_space(size: int, largest: float) -> Box:
    """Bounds of an observation [D]: speed over desired speed, then numbers from -1 to the largest of its form."""
    low, high = np.full(size, -1.0, np.float32), np.full(size, largest, np.float32)
    low[0], high[0] = 0.0, SPEED_RATIO_LIMIT
    return Box(low, high, dtype=np.float32)


class OnRows:
    """Base of the environments on :class:`Rows`; their ``spec`` has their own time limit."""

    _rows: Rows
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """gymnasium's specification; ``max_episode_steps`` follows from ``timeout_s``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = copy.copy(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = self._rows.episode.most_decisions()


def copied(info: dict[str, Any]) -> dict[str, Any]:
    """A copy of an info, which the caller may keep."""
    return {name: copied(value) if isinstance(value, dict) else value.copy() for name, value in info.items()}


def row_of(info: dict[str, Any], row: int) -> dict[str, Any]:
    """One row of :meth:`Rows.info`, numbers as Python's."""
    return {name: _item(value, row) for name, value in info.items()}


def _item(value: Any, row: int) -> Any:
    if isinstance(value, dict):
        return row_of(value, row)
    return value[row].copy() if value.ndim > 1 else value.item(row)


def array_of(given: Any) -> npt.NDArray[Any]:
    """A user's value as an array; an array of None if it cannot be one, such as lists of different lengths."""
    try:
        return np.asarray(given)
    except (TypeError, ValueError, RuntimeError):
        return np.asarray(None)


def actions_of(given: Any, rows: int) -> npt.NDArray[np.int64]:
    """A user's actions as an array [rows] int64.

    Raises:
        UserError: another shape, or no such action.
    """
    array = array_of(given)
    whole = array.shape == (rows,) and array.dtype.kind in "iu"
    if not whole or not 0 <= array.min() <= array.max() < ACTIONS:
        raise UserError(
            f"action {given!r:.80}: expected {rows} whole number(s), 0 (keep), 1 (left) or 2 (right); give one "
            "for every environment."
        )
    return array.astype(np.int64, copy=False)


def known_options(options: dict[str, Any] | None, names: tuple[str, ...]) -> dict[str, Any]:
    """The options of a reset, checked for unknown names."""
    if not isinstance(options, dict | None):
        raise UserError(f"options={options!r}: expected a dictionary with {', '.join(names)}, or none.")
    unknown = sorted(map(str, set(options or {}) - set(names)))
    if unknown:
        raise UserError(f"options: {', '.join(unknown)} unknown; a reset takes {', '.join(names)}.")
    return dict(options or {})


def episode_numbers(episode: Any) -> npt.NDArray[np.int64]:
    """The option ``episode``, checked: whole numbers from 0, one or several."""
    array = array_of(episode)
    numbers = array.astype(np.int64) if array.dtype.kind in "iu" else np.asarray(-1)
    if (numbers < 0).any():
        raise UserError(f"options: episode={episode!r:.80}: expected whole numbers from 0; give for instance 3.")
    return numbers


def row_mask(mask: Any, rows: int) -> Flags:
    """The option ``reset_mask``, checked: a boolean array [rows]."""
    array = array_of(mask)
    if array.shape != (rows,) or array.dtype != np.bool_:
        raise UserError(
            f"options: reset_mask: expected a boolean array of shape ({rows},); give one flag for every row."
        )
    return array
