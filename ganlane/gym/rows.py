"""Basis of the single and the vector environment: N highways behind NumPy arrays, and checks of
arguments.

:class:`Rows` is the interface. :class:`NativeRows` implements it for rule-driven traffic, by the
native kernel and without torch; :class:`ganlane.gym.tensor_rows.TensorRows` for everything else, by
the TorchRL environment.
"""

# ruff: noqa: D102 - Rows has the docstrings of the methods
from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from numbers import Integral
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box

from ganlane import keys
from ganlane.settings.commands import RunConfig
from ganlane.settings.env import EnvConfig, check_reward
from ganlane.settings.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.native.batch import SPEED_RATIO_LIMIT, NativeBatch, Stepped
from ganlane.native.library import why_not
from ganlane.native.settings import NATIVE_FORMS
from ganlane.options import Option, option
from ganlane.settings.episode import EpisodeParameters, Stream

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
#: Exclusive upper bound of the seeds that unseeded environments draw.
SEEDS: Final = 2**31
#: Traffic that the kernel implements, and whether it changes lanes.
_NATIVE_TRAFFICS = {"ganlane.traffic.IdmTraffic": False, "ganlane.traffic.IdmMobilTraffic": True}


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
        """Allowed actions [N, 3]: the mask's, without one those that stay on the road.

        Valid until the next call.
        """

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


def observation_space(size: int, largest: float) -> Box:
    """Bounds of an observation [D].

    Speed over desired speed, then numbers from -1 to the largest of its form.
    """
    low, high = np.full(size, -1.0, np.float32), np.full(size, largest, np.float32)
    low[0], high[0] = 0.0, SPEED_RATIO_LIMIT
    return Box(low, high, dtype=np.float32)


def make_rows(
    traffic: Option, count: int, render_mode: str | None, options: Mapping[str, Any]
) -> Rows:
    """N highways with ``traffic`` and the ``options`` of :func:`ganlane.api.make_env`.

    The native kernel drives them where it can, unless the option ``kernel`` is ``torch`` or there
    is a ``render_mode``, since the kernel shows no physics steps.

    Raises:
        UserError: a wrong value.
    """
    if render_mode is None and why_not() is None:
        rows = native_rows(traffic, count, dict(options))
        if rows is not None:
            return rows
    from ganlane.gym.tensor_rows import TensorRows  # torch takes seconds

    return TensorRows(traffic, count, options)


def native_rows(traffic: Option, count: int, options: dict[str, Any]) -> NativeRows | None:
    """N highways by the kernel.

    None where it does not implement these options, or one of them is wrong.
    """
    groups = ("env", "observation", "reward", "mask", "stream", "device", "transforms")
    given = {name: options.pop(name) for name in groups if name in options}
    try:
        config: TrafficConfig = option("traffic", traffic)
        env: EnvConfig = option("env", given.get("env"), options)
        observation, reward, mask = (
            option(group, given.get(group)) for group in ("observation", "reward", "mask")
        )
        check_reward(env, reward)
        device = RunConfig(device=given.get("device", "cpu")).device
        stream = Stream.named(str(given.get("stream", "train")))
    except UserError:
        return None  # TensorRows reports the mistake
    implemented = (
        config._target_ in _NATIVE_TRAFFICS and not config.blind_share and not config.parameters
        and observation.form in NATIVE_FORMS and observation.sensors is None
        and type(env).scenes is EnvConfig.scenes and env.kernel != "torch"
        and isinstance(count, Integral) and 1 <= count <= 65536
        and device == "cpu" and not len(given.get("transforms", ()))
    )  # fmt: skip
    if not implemented:
        return None
    batch = NativeBatch(
        int(count),
        env.lanes,
        env.lane_width_m,
        env.vehicles,
        env.spawn_parameters(),
        env.ego,
        env.episode_parameters(),
        env.idm,
        env.mobil if _NATIVE_TRAFFICS[config._target_] else None,
        env.recycle_share if env.recycle else None,
        observation,
        reward,
        mask,
        int(stream),
    )
    return NativeRows(batch, env.episode_parameters())


class NativeRows(Rows):
    """N highways by the native kernel."""

    def __init__(self, batch: NativeBatch, episode: EpisodeParameters) -> None:
        self.batch, self.count, self.episode = batch, batch.rows, episode
        self.space = observation_space(batch.observation.shape[1], batch.bounds[1])
        self._started = False
        self._never = np.zeros(batch.rows, np.bool_)

    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        self._started = True
        self.batch.start(seed, episode)

    def restart(self, rows: Flags) -> None:
        state = self.batch.state
        self.batch.start(state["seed"], state["episode"] + self.count, rows)

    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        return self.batch.step(actions)

    def observation(self) -> Floats:
        return self.batch.observation

    def mask(self) -> Flags:
        return self.batch.mask

    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
        state = self.batch.state
        return (state["seed"], state["episode"]) if self._started else None

    def info(self) -> dict[str, Any]:
        batch, state = self.batch, self.batch.state
        y = state[keys.VEHICLES, "y"][:, 0]
        lane = np.rint(y / np.float32(batch.lane_width_m)).astype(np.int64)
        events = ("goal", "hard_crash", "out_of_road", "timeout", *keys.EVENT_COUNTS)
        return {
            "seed": state[keys.SEED],
            "episode_number": state[keys.EPISODE],
            "time_s": state[keys.STEP] * keys.PHYSICS_STEP_S,
            "distance_m": state[keys.EGO, "distance"],
            "speed_mps": state[keys.VEHICLES, "speed"][:, 0],
            "lane": np.minimum(np.maximum(lane, 0), batch.lanes - 1),
            "decisions": state[keys.EGO, "decisions"],
            "lane_changes": state[keys.EGO, "lane_changes"],
            "action_mask": batch.mask.view(np.int8),
            **{name: state[keys.EVENTS, name] for name in events},
            "scene_end": self._never,
            keys.REWARD_TERMS: batch.reward_terms(),
        }


class OnRows:
    """Base of the environments on :class:`Rows`."""

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


def row_of(info: Any, row: int) -> Any:
    """One row of :meth:`Rows.info`, or of one of its values, numbers as Python's."""
    if isinstance(info, dict):
        return {name: row_of(value, row) for name, value in info.items()}
    return info[row].copy() if info.ndim > 1 else info.item(row)


def array_of(given: Any) -> npt.NDArray[Any]:
    """A user's value as an array.

    An array of None if it cannot be one, such as lists of different lengths.
    """
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
    if not whole or not 0 <= array.min() <= array.max() < keys.ACTIONS:
        raise UserError(
            f"action {given!r:.80}: expected {rows} whole number(s), 0 (keep), 1 (left) or 2 (right); give one "
            "for every environment."
        )
    return array.astype(np.int64, copy=False)


def known_options(options: dict[str, Any] | None, names: tuple[str, ...]) -> dict[str, Any]:
    """The options of a reset, checked for unknown names."""
    if not isinstance(options, dict | None):
        raise UserError(
            f"options={options!r}: expected a dictionary with {', '.join(names)}, or none."
        )
    unknown = sorted(map(str, set(options or {}) - set(names)))
    if unknown:
        raise UserError(f"options: {', '.join(unknown)} unknown; a reset takes {', '.join(names)}.")
    return dict(options or {})
