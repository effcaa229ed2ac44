"""A batch of highways on NumPy arrays: a whole step (drive, reward, mask, observation) in one call
of the kernel.

What gymnasium's environments stand on (:mod:`ganlane.gym`). Imports no torch, so it is there in a
fraction of a second, and costs microseconds where a TensorDict costs milliseconds. Its episodes
are, number for number, those of the TorchRL environment with ``env.kernel=native``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ganlane.native import settings
from ganlane.native.library import addresses, in_threads, load
from ganlane.settings.driving import EgoParameters, IdmParameters, MobilParameters, Visibility
from ganlane.settings.episode import EpisodeParameters, SpawnParameters
from ganlane.settings.observation import (
    MASKS,
    MaskParameters,
    ObservationConfig,
    RewardParameters,
    largest_number,
)

#: Speed over desired speed beyond which the observation is cut off, for a space with bounds; IDM
#: stays far below.
SPEED_RATIO_LIMIT = 4.0
# The structures of observation.cpp and mask.cpp, in their order.
_VIEW = (
    "speed",
    "desired_speed",
    "length",
    "y",
    "x",
    "y",
    "speed",
    "valid",
    "change_progress",
    "change_direction",
)
_MASK = (
    "x", "y", "heading", "speed", "length", "width", "desired_speed", "target_lane", "visibility", "valid",
    "change_direction",
)  # fmt: skip


class _Batch(ctypes.Structure):
    """``Batch`` of step.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in (
            "settings", "inputs", "outputs", "spawn", "scene", "reward_settings", "reward", "terms",
            "view", "view_inputs", "observation", "mask_settings", "mask_inputs", "mask_outputs", "mask",
        )),
        *((name, ctypes.c_float) for name in ("lowest", "highest", "fastest")),
        *((name, ctypes.c_int32) for name in ("vehicles", "lanes", "size", "mask_form", "abort_lane_change")),
    )  # fmt: skip


class Stepped(NamedTuple):
    """What a decision led to; arrays of the batch itself, which the next call overwrites.

    ``observation`` [N, D] and ``reward`` [N] float32, ``terminated`` and ``truncated`` [N] bool.
    """

    observation: npt.NDArray[np.float32]
    reward: npt.NDArray[np.float32]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]


class NativeBatch:
    """N highways with rule-driven traffic, from the random first scenes of Table II.

    Args:
        rows: N.
        lanes, lane_width_m: of the road.
        vehicles: M, the ego included.
        spawn, ego, episode: the first scene, what is special about the ego, and the episode's end.
        idm: car following of all.
        mobil: lane changes of the others; None: they keep their lanes.
        recycle_share: share of the episodes in which vehicles left behind return ahead; None: of
            none.
        observation: one of :data:`ganlane.native.settings.NATIVE_FORMS`, without sensor errors.
        reward: section V.C.
        mask: of the ego's actions; ``none``: those that stay on the road.
        stream: family of episodes.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.

    Attributes:
        state: name to array, [N, M] of the vehicles, [N] of the rest.

    Raises:
        UserError: the kernel cannot be built here.
    """

    def __init__(
        self,
        rows: int = 1,
        lanes: int = 3,
        lane_width_m: float = 4.0,
        vehicles: int = 9,
        spawn: SpawnParameters | None = None,
        ego: EgoParameters | None = None,
        episode: EpisodeParameters | None = None,
        idm: IdmParameters | None = None,
        mobil: MobilParameters | None = None,
        recycle_share: float | None = None,
        observation: ObservationConfig | None = None,
        reward: RewardParameters | None = None,
        mask: MaskParameters | None = None,
        stream: int = 0,
        variant: str | None = None,
    ) -> None:
        self._arguments = {name: value for name, value in locals().items() if name != "self"}
        spawn, ego, episode = (
            spawn or SpawnParameters(),
            ego or EgoParameters(),
            episode or EpisodeParameters(),
        )
        observation, reward = observation or ObservationConfig(), reward or RewardParameters()
        idm, mask = idm or IdmParameters(), mask or MaskParameters()
        road = (lanes, lane_width_m, vehicles)
        self.rows, self.lanes, self.lane_width_m, self.terms = (
            rows,
            lanes,
            lane_width_m,
            reward.term_names,
        )
        view = settings.view_of(*road, observation.scale(), observation.form)
        self.bounds = (-1.0, largest_number(observation.form, spawn.longest_m))
        self.state: dict[str, npt.NDArray[Any]] = {
            **{
                name: np.zeros((rows, vehicles), kind)
                for name, kind in settings.VEHICLE_ARRAYS.items()
            },
            **{
                name: np.zeros(rows, kind)
                for name, kind in (settings.ROW_ARRAYS | settings.EVENT_ARRAYS).items()
            },
        }
        self.observation = np.zeros((rows, view.numbers()), np.float32)
        self.mask = np.ones((rows, 3), np.bool_)
        self._term_values = np.zeros((rows, len(self.terms)), np.float32)
        self._no_safe_action = np.zeros(rows, np.bool_)
        self._library = load(variant)
        visible = Visibility.named(ego.visibility)
        pointed = {
            "settings": settings.settings_of(*road, episode, ego, idm, mobil=mobil),
            "inputs": self._pointers(settings.INPUTS),
            "outputs": self._pointers(settings.OUTPUTS),
            "spawn": settings.spawn_of(
                *road, spawn, stream, visible, Visibility.SIGNALLED, recycle_share
            ),
            "scene": self._pointers(settings.SCENE),
            "reward_settings": settings.reward_of(reward, episode.decision_period_s),
            "view": view,
            "view_inputs": self._pointers(_VIEW),
            "mask_settings": settings.safe_settings(
                *road, idm, mask.safe_deceleration, ego.abort_lane_change
            ),
            "mask_inputs": self._pointers(_MASK),
            "mask_outputs": addresses([self.mask, self._no_safe_action]),
        }
        self._pointed = pointed  # kept, since the structure holds no more than their addresses
        self._batch = _Batch(
            **{name: ctypes.addressof(each) for name, each in pointed.items()},
            reward=self.state["reward"].ctypes.data,
            terms=self._term_values.ctypes.data,
            observation=self.observation.ctypes.data,
            mask=self.mask.ctypes.data,
            lowest=self.bounds[0],
            highest=self.bounds[1],
            fastest=SPEED_RATIO_LIMIT,
            vehicles=vehicles,
            lanes=lanes,
            size=view.numbers(),
            mask_form=MASKS.index(mask.form),
            abort_lane_change=ego.abort_lane_change,
        )
        self._address = ctypes.byref(self._batch)
        self._stepped = Stepped(
            self.observation, *(self.state[name] for name in ("reward", "terminated", "truncated"))
        )

    def __getstate__(self) -> dict[str, Any]:
        """What it was made of, and its numbers.

        Pointers and the library hold in this process alone.
        """
        return {"arguments": self._arguments, "arrays": self._arrays()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state["arguments"])  # type: ignore[misc]  # anew, in place
        for array, kept in zip(self._arrays(), state["arrays"]):
            array[:] = kept

    def _arrays(self) -> list[npt.NDArray[Any]]:
        return [
            *self.state.values(),
            self.observation,
            self.mask,
            self._term_values,
            self._no_safe_action,
        ]

    def _pointers(self, names: Sequence[str]) -> ctypes.Array[ctypes.c_void_p]:
        return addresses([self.state[name] for name in names])

    def start(
        self, seed: npt.ArrayLike, episode: npt.ArrayLike, rows: npt.NDArray[np.bool_] | None = None
    ) -> None:
        """Begin the episodes [N] of the seeds [N], each perhaps one number for all, in ``rows`` [N]
        (None: all).
        """
        state = self.state
        fresh = state["fresh"]
        fresh[:] = True if rows is None else rows
        np.copyto(state["seed"], seed, where=fresh)
        np.copyto(state["episode"], episode, where=fresh)
        self._in_threads(self._library.ganlane_start)

    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        """One decision of every row, by the actions [N]; no row is reset."""
        self.state["action"][:] = actions
        self._in_threads(self._library.ganlane_step)
        return self._stepped

    def _in_threads(self, function: Callable[..., int]) -> None:
        batch = self._address
        in_threads(self.rows, lambda first, last: function(batch, first, last))

    def reward_terms(self) -> dict[str, npt.NDArray[np.float32]]:
        """The terms of the last reward by name, each [N]."""
        return dict(zip(self.terms, self._term_values.T))
