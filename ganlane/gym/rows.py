"""N highways behind NumPy arrays: what both environments stand on, and checks of arguments.

:class:`Rows` is the interface, with one specification of gymnasium's info.
:class:`ganlane.gym.native_rows.NativeRows` implements it where the native kernel drives,
without torch; :class:`ganlane.gym.tensor_rows.TensorRows` for everything else, by the TorchRL
environment.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Discrete

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native.batch import SPEED_RATIO_LIMIT, Stepped
from ganlane.native.settings import Array, Floats, Key
from ganlane.settings.actions import CONTROLS, ActionParameters
from ganlane.settings.commands import HighwayConfig
from ganlane.settings.episode import EpisodeParameters

Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
#: Exclusive upper bound of the seeds that unseeded environments draw.
SEEDS: Final = 2**31
#: Those parts of gymnasium's info that are arrays of the state as they are, and their keys there.
INFO: Final[dict[str, Key]] = {
    "seed": keys.SEED,
    "episode_number": keys.EPISODE,
    "distance_m": (keys.EGO, "distance"),
    "speed_mps": (keys.VEHICLES, "speed"),
    "decisions": (keys.EGO, "decisions"),
    "lane_changes": (keys.EGO, "lane_changes"),
    **{name: (keys.EVENTS, name) for name in (*keys.END_EVENTS, *keys.EVENT_COUNTS)},
}
#: Its name of the allowed actions.
ACTION_MASK: Final = "action_mask"
#: Parts of the info that are no number per row.
NO_NUMBERS: Final = (ACTION_MASK, keys.REWARD_TERMS)


class Rows(ABC):
    """N highways.

    Attributes:
        count: N.
        space: of one observation.
        config: the settings of the highways.
        transforms: a user's own, after observation and reward.
        episode: decision period and time limit.
        started: whether an episode is under way.
    """

    # Whether an episode was ever begun; gymnasium wants reset() before the first step().
    started = False
    count: int
    space: Box
    config: HighwayConfig
    transforms: Sequence[Any] = ()
    episode: EpisodeParameters

    @abstractmethod
    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        """Begin the episodes [N] of the seeds [N]; each may be one number for all rows."""

    @abstractmethod
    def restart(self, rows: Flags) -> None:
        """Begin the next episode, number n + N after n, in the rows where ``rows`` [N] is true."""

    @property
    def actions(self) -> ActionParameters:
        """What the driver of the ego commands."""
        return self.config.env.actions

    def action_space(self) -> Box | Discrete:
        """Of one action."""
        if self.actions.names:
            return Discrete(len(self.actions.names))
        return Box(-1.0, 1.0, (CONTROLS,), np.float32)

    @abstractmethod
    def step(self, actions: Integers | Floats) -> Stepped:
        """One decision in every row; no row is reset. The arrays are valid until the next call."""

    @abstractmethod
    def observation(self) -> Floats:
        """Observations [N, D], within the space; valid until the next call."""

    @abstractmethod
    def mask(self) -> Flags:
        """Allowed actions [N, A]: the mask's, without one those that stay on the road.

        Of actions that are not numbered [N, 0].

        Valid until the next call.
        """

    @abstractmethod
    def array(self, key: Key) -> Array:
        """An array [N] of the state (:mod:`ganlane.keys`), of ``vehicles`` the ego's."""

    @abstractmethod
    def driven(self) -> tuple[npt.NDArray[np.float64], Integers]:
        """Time since the start of the episode in s, and the lane that the ego is in, each [N].

        An ego that has left the road is in the outer lane.
        """

    @abstractmethod
    def reward_terms(self) -> dict[str, Array]:
        """The terms of the last reward by name, each [N]."""

    def check_started(self) -> None:
        """Raise :class:`UserError` before the first :meth:`start`."""
        if not self.started:
            raise UserError("no episode is under way; call reset() first.")

    def info(self) -> dict[str, Any]:
        """Gymnasium's info (docs/gymnasium.md) as arrays [N] by name; valid until the next call."""
        info: dict[str, Any] = {name: self.array(key) for name, key in INFO.items()}
        info["time_s"], info["lane"] = self.driven()

        # gymnasium's Discrete.sample() takes masks of int8; the bytes of booleans are the same.
        if self.actions.names:
            info[ACTION_MASK] = self.mask().view(np.int8)

        info[keys.REWARD_TERMS] = self.reward_terms()
        return info

    def first_info(self) -> dict[str, Any]:
        """The info of the first row, with Python's numbers; valid for good."""
        return row_of(self.info(), 0)


def observation_space(size: int, largest: float) -> Box:
    """Bounds of an observation [D].

    Speed over desired speed, then numbers from -1 to the largest of its form.
    """
    # float32, as the observations are; a wider type would not contain them.
    low = np.full(size, -1.0, np.float32)
    high = np.full(size, largest, np.float32)
    # The first number is the ego's speed as a ratio, which is never negative.
    low[0] = 0.0
    high[0] = SPEED_RATIO_LIMIT
    return Box(low, high, dtype=np.float32)


def row_of(info: Mapping[str, Any], row: int) -> dict[str, Any]:
    """One row of :meth:`Rows.info`, numbers as Python's."""
    # Of the numbers by a plain loop over methods: with a test of every value it took half as long
    # again.
    values = {name: value.item(row) for name, value in info.items() if name not in NO_NUMBERS}

    # A copy, since arrays are views of what the next step overwrites.
    if ACTION_MASK in info:
        values[ACTION_MASK] = info[ACTION_MASK][row].copy()

    terms = info[keys.REWARD_TERMS]
    values[keys.REWARD_TERMS] = {name: value.item(row) for name, value in terms.items()}
    return values


def array_of(value: Any) -> npt.NDArray[Any]:
    """A user's value as an array.

    An array of None if it cannot be one, such as lists of different lengths. Nothing is raised: the
    caller knows what was expected.
    """
    try:
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        # An array without numbers, which the caller's check of the type refuses.
        return np.asarray(None)


def action_of(action: Any, actions: ActionParameters, number: Integers) -> Integers | Floats:
    """A user's action of one environment, [1] or [1, 2]; of a number an array of one will do.

    A plain number is written to ``number`` [1], which is given back.

    Raises:
        UserError: as :func:`actions_of`.
    """
    # Plain numbers are most of them; to look at an array takes 3 of a step's 20 microseconds.
    if type(action) in (int, np.int64) and 0 <= action < len(actions.names):
        number[0] = action
        return number
    array = array_of(action)
    # A batch of one row: of numbers [1], of controls [1, 2].
    batch = array.reshape(-1) if actions.names else array[None]
    return actions_of(batch, 1, actions)


def actions_of(commanded: Any, rows: int, actions: ActionParameters) -> Integers | Floats:
    """A user's actions as an array [rows] int64, or [rows, 2] float32.

    Raises:
        UserError: another shape, no such action, or a number that is not finite.
    """
    array = array_of(commanded)

    # Continuous controls have no names.
    if not actions.names:
        fits = array.shape == (rows, CONTROLS) and array.dtype.kind in "iuf"
        if not fits or not np.isfinite(array).all():
            raise UserError(
                f"action {commanded!r:.80}: expected {rows} times {CONTROLS} numbers from -1 to 1, "
                "acceleration and lateral target; give both for every environment."
            )
        return array.astype(np.float32, copy=False)

    # The type is looked at before any cast, which would round and wrap.
    numbers = None
    if array.shape == (rows,) and array.dtype.kind in "iu":
        numbers = array.astype(np.int64, copy=False)
    # As unsigned numbers those below 0 are above all others: one search in place of two.
    if numbers is None or numbers.view(np.uint64).max() >= len(actions.names):
        raise UserError(
            f"action {commanded!r:.80}: expected {rows} whole number(s), "
            f"{actions.meanings()}; give one for every environment."
        )
    return numbers


def reset_options(options: dict[str, Any] | None, names: tuple[str, ...]) -> dict[str, Any]:
    """The options of a reset as a new dictionary.

    Raises:
        UserError: they are no dictionary, or have a key that is not in ``names``.
    """
    if not isinstance(options, dict | None):
        raise UserError(
            f"options={options!r}: expected a dictionary with {', '.join(names)}, or none."
        )
    # As text, since a user's keys may be of types that cannot be sorted together.
    unknown = sorted(map(str, set(options or {}) - set(names)))
    if unknown:
        raise UserError(f"options: {', '.join(unknown)} unknown; a reset takes {', '.join(names)}.")
    return dict(options or {})
