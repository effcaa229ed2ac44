"""A batch of highways on NumPy arrays: a whole step (drive, reward, mask, observation) in one call
of the kernel.

What gymnasium's environments stand on (:mod:`ganlane.gym`). Imports no torch, so it is there in a
fraction of a second, and costs microseconds where a TensorDict costs milliseconds. Its episodes
are, number for number, those of the TorchRL environment with ``env.kernel=native``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.native import settings
from ganlane.native.drivers import (
    Drivers,
    by_network,
    decision_settings,
    mask_settings,
    parts_of,
    rows_per_thread,
    turns_of,
)
from ganlane.native.library import addresses, in_threads, load, load_for
from ganlane.native.settings import Array, Floats, Highway, Key, Layout, fields, filled, within
from ganlane.settings.actions import CONTROLS, LANE, LANE_SPEED
from ganlane.settings.commands import HighwayConfig
from ganlane.settings.driving import Visibility
from ganlane.settings.episode import Stream
from ganlane.settings.observation import MASKS, largest_number

#: Speed over desired speed beyond which the observation is cut off, for a space with bounds; IDM
#: stays far below.
SPEED_RATIO_LIMIT = 4.0
#: The arrays of a batch beside those of the state.
_ROW_ARRAYS: dict[Key, str] = {
    keys.ACTION: "int64",
    keys.REWARD: "float32",
    **dict.fromkeys(("recycles", "fresh"), "bool"),
}
# What a function of the kernel reads, in the order of its structure in C++. The ego perceives all
# vehicles as they are: of what it sees and of what there is the view reads the same arrays.
_VIEWS = (
    *within(keys.VEHICLES, f"{settings.VIEWED_EGO} {settings.VIEWED}"),
    *within(keys.EGO, "change_progress change_direction"),
    *within(keys.VEHICLES, "x heading"),
    settings.SET_SPEED,
)
_MASKS = (*within(keys.VEHICLES, settings.MASKED), (keys.EGO, "change_direction"))


class _Batch(settings.Structure):
    """``Batch`` of step.cpp."""

    _fields_ = (
        *fields(
            ctypes.c_void_p,
            "settings inputs outputs spawn scene reward_settings reward terms view view_inputs"
            " observation mask_settings mask_inputs mask_outputs mask speed_mask",
        ),
        *fields(ctypes.c_float, "lowest highest fastest"),
        *fields(ctypes.c_int32, "vehicles lanes size mask_form abort_lane_change"),
    )


class Stepped(NamedTuple):
    """What a decision led to; arrays of the batch itself, which the next call overwrites.

    ``observation`` [N, D] and ``reward`` [N] float32, ``terminated`` and ``truncated`` [N] bool.
    """

    observation: Floats
    reward: Floats
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]


class _Part(NamedTuple):
    """What drives the rows of one part of the drivers, and its rows."""

    batch: _Batch
    #: To ``batch``.
    pointer: Any
    rows: npt.NDArray[np.int64] | None
    rows_per_thread: int

    def call(self, function: Callable[..., int], count: int) -> None:
        """A function of a whole batch, on ``count`` rows."""
        # One pointer is all that it passes. Rows are independent, so any split between threads
        # gives the same numbers.
        in_threads(count, partial(function, self.pointer), self.rows_per_thread)

    def drive(self, decide: Callable[..., int], count: int) -> None:
        """The first ``count`` of ``rows``."""
        pointers = (self.batch.settings, self.batch.inputs, self.batch.outputs)
        in_threads(count, lambda first, last: decide(*pointers, first, last), self.rows_per_thread)


class NativeBatch:
    """N highways as ``config`` describes them.

    Args:
        config: with an observation of :data:`ganlane.native.settings.NATIVE_FORMS` and without
            sensor errors.
        drivers: the others, and how the ego follows.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.

    Attributes:
        state: the environment's state (:mod:`ganlane.keys`) as arrays by key, ``("vehicles", "x")``
            [N, M], ``("ego", "distance")`` and the rest [N].

    Raises:
        UserError: the kernel cannot be built here.
    """

    def __init__(self, config: HighwayConfig, drivers: Drivers, variant: str | None = None) -> None:
        self.config = config
        # For copies and other processes, which make the batch anew.
        self._arguments = (config, drivers, variant)
        env, mask, form = config.env, config.mask, config.observation.form
        episode, spawn, actions = env.episode_parameters(), env.spawn_parameters(), env.actions
        flow = env.flow if env.flow.is_on else None
        road = (env.lanes, env.lane_width_m, env.vehicles)
        highway = Highway(*road, env.stretches(), flow, actions)
        self.rows = rows = config.num_envs
        self.terms = config.reward.term_names
        view = settings.view_of(highway, config.observation, form)
        scene = env.scenes()
        longest_m = spawn.longest_m if scene is None else scene.longest_m
        self.bounds = (-1.0, largest_number(form, longest_m))
        # All arrays of the state in place, written by the kernel and read by whoever asks.
        layout = Layout(drivers.memory(), highway)
        self.state: dict[Key, Array] = {
            name: np.zeros(layout.shape(name, rows, env.vehicles), kind)
            for name, kind in layout.kinds.items()
        }
        self.state |= {name: np.zeros(rows, kind) for name, kind in _ROW_ARRAYS.items()}
        self._commands = self.state[keys.ACTION]
        if not actions.names:
            self._commands = self.state["controls"] = np.zeros((rows, CONTROLS), np.float32)
        self.observation = np.zeros((rows, view.numbers()), np.float32)
        self._lane_mask = np.ones((rows, keys.ACTIONS), np.bool_)
        self.mask = self._lane_mask
        if actions.form != LANE:
            self.mask = np.ones((rows, len(actions.names)), np.bool_)
        self._term_values = np.zeros((rows, len(self.terms)), np.float32)
        self._first_terms = self._term_values[0]
        self._no_safe_action = np.zeros(rows, np.bool_)
        # A network fills the widest vectors with its own numbers.
        widest = variant or by_network(drivers)
        self._library = load(variant) if widest else load_for(rows)
        abort = env.ego.abort_lane_change
        # The kernel's structures, filled once.
        reward = vars(config.reward) | {
            "decision_period_s": episode.decision_period_s,
            "terms": len(self.terms),
        }
        numbers = highway._asdict() | {
            "reward_settings": filled(settings.Reward, reward),
            "view": view,
            "view_inputs": self._pointers(_VIEWS),
            "mask_settings": mask_settings(highway, drivers.idm, mask, abort),
            "mask_inputs": self._pointers(_MASKS),
            "mask_outputs": addresses([self._lane_mask, self._no_safe_action]),
            "scene": self._pointers(settings.STARTS),
            "reward": self.state[keys.REWARD],
            "terms": self._term_values,
            "observation": self.observation,
            "mask": self._lane_mask,
            "speed_mask": self.mask if actions.form == LANE_SPEED else None,
            "lowest": self.bounds[0],
            "highest": self.bounds[1],
            "fastest": SPEED_RATIO_LIMIT,
            "size": view.numbers(),
            "mask_form": MASKS.index(mask.form),
            "abort_lane_change": abort,
        }
        recycle_share = env.recycle_share if env.recycle else None
        if flow is not None:
            # In every episode vehicles enter and leave.
            recycle_share = 1.0
        self._turns = np.array(turns_of(drivers))
        self._parts = []
        for part in parts_of(drivers):
            layout = Layout(part.memory, highway)
            # Of several parts each drives the rows that are its own.
            row_list = np.zeros(rows, np.int64) if len(self._turns) > 1 else None
            # When others see the ego's lane changes, and the ego theirs.
            others = part.drivers.visibility
            visible = (Visibility.named(env.ego.visibility), others)
            start = (Stream.named(config.stream), *visible, recycle_share, env.scenes(others))
            of_part = {
                "settings": decision_settings(highway, part.drivers, episode, env.ego, env.mobil),
                "inputs": self._pointers(layout.inputs, row_list),
                "outputs": self._pointers(layout.outputs),
                "spawn": settings.spawn_of(highway, spawn, *start),
            }
            batch = filled(_Batch, numbers | of_part)
            per_thread = rows_per_thread(part.drivers)
            self._parts.append(_Part(batch, ctypes.byref(batch), row_list, per_thread))
        ends = (self.state["terminated"], self.state["truncated"])
        self._stepped = Stepped(self.observation, self.state[keys.REWARD], *ends)

    def __getstate__(self) -> dict[str, Any]:
        """What it was made of, and its numbers.

        Pointers and the library hold in this process alone.
        """
        return {"arguments": self._arguments, "arrays": self._arrays()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"])  # type: ignore[misc]  # anew, in place
        # Copied, since the kernel's structures hold the addresses of these arrays.
        for array, numbers in zip(self._arrays(), state["arrays"]):
            array[:] = numbers

    def _arrays(self) -> list[Array]:
        return [*self.state.values(), self.observation, self.mask, self._term_values]

    def _pointers(
        self, names: Iterable[Key], rows: Array | None = None
    ) -> ctypes.Array[ctypes.c_void_p]:
        arrays: dict[Key, Any] = {**self.state, "rows": rows}
        return addresses([arrays.get(name) for name in names])

    def start(
        self, seed: npt.ArrayLike, episode: npt.ArrayLike, rows: npt.NDArray[np.bool_] | None = None
    ) -> None:
        """Begin the episodes [N] of the seeds [N], each perhaps one number for all, in ``rows`` [N]
        (None: all).
        """
        state = self.state
        fresh = state["fresh"]
        # The kernel starts the rows whose flag is set and leaves the others alone.
        fresh[:] = True if rows is None else rows
        np.copyto(state[keys.SEED], seed, where=fresh)
        np.copyto(state[keys.EPISODE], episode, where=fresh)
        starting = fresh.copy()
        for number, part in enumerate(self._parts):
            if part.rows is not None:
                fresh[:] = starting & (self._part_of_row() == number)
            part.call(self._library.ganlane_start, self.rows)

    def _part_of_row(self) -> npt.NDArray[np.int64]:
        return self._turns[self.state[keys.EPISODE] % len(self._turns)]

    def step(self, actions: Array) -> Stepped:
        """One decision of every row, by the actions [N] or [N, 2]; no row is reset."""
        # Copied, since the kernel holds the address of this array.
        self._commands[:] = actions
        if len(self._parts) == 1:
            self._parts[0].call(self._library.ganlane_step, self.rows)
            return self._stepped
        part_of_row = self._part_of_row()
        for number, part in enumerate(self._parts):
            chosen = np.flatnonzero(part_of_row == number)
            assert part.rows is not None
            part.rows[: len(chosen)] = chosen
            part.drive(self._library.ganlane_decide, len(chosen))
        self._parts[0].call(self._library.ganlane_judge, self.rows)
        return self._stepped

    def first_reward_terms(self) -> dict[str, float]:
        """Those of the first row."""
        return dict(zip(self.terms, self._first_terms.tolist()))

    def reward_terms(self) -> dict[str, Floats]:
        """The terms of the last reward by name, each [N]."""
        return dict(zip(self.terms, self._term_values.T))
