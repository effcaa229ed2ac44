"""A batch of highways on NumPy arrays: a whole step (drive, reward, mask, observation) in one call
of the kernel.

What gymnasium's environments stand on (:mod:`ganlane.gym`). Imports no torch, so it is there in a
fraction of a second, and costs microseconds where a TensorDict costs milliseconds. Its episodes
are, number for number, those of the TorchRL environment with ``env.kernel=native``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
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
from ganlane.native.drivers import Part as DriverPart
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
#: The arrays [rows] of a batch beside those of the state: whether vehicles left behind come back
#: ahead in this episode, and whether an episode is to begin.
_ROW_ARRAYS: dict[Key, str] = {
    keys.ACTION: "int64",
    keys.REWARD: "float32",
    "recycles": "bool",
    "fresh": "bool",
}

# What a function of the kernel reads, in the order of its structure in C++. The ego perceives all
# vehicles as they are: of what it sees and of what there is the view reads the same arrays.
_VIEWS = (
    *within(keys.VEHICLES, settings.VIEWED_EGO),
    *within(keys.VEHICLES, settings.VIEWED),
    *within(keys.EGO, "change_progress change_direction"),
    *within(keys.VEHICLES, "x heading"),
    settings.SET_SPEED,
)
_MASKS = (
    *within(keys.VEHICLES, settings.MASKED),
    (keys.EGO, "change_direction"),
)


class _Batch(settings.Structure):
    """``Batch`` of step.cpp: all that a step of the rows reads and writes.

    :meth:`NativeBatch._common_members` and :meth:`NativeBatch._part_of` say what each member is.
    """

    _fields_ = (
        *fields(
            ctypes.c_void_p,
            "settings inputs outputs spawn scene"
            " reward_settings reward terms"
            " view view_inputs observation"
            " mask_settings mask_inputs mask_outputs mask speed_mask"
            " time_s lane",
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
    #: Numbers of its rows at the front, [N]; None: it drives all.
    rows: npt.NDArray[np.int64] | None
    #: Rows from which on a further thread pays.
    rows_per_thread: int

    def call(self, function: Callable[..., int], count: int) -> None:
        """Call a function of the kernel that works on a whole batch, on ``count`` rows."""
        in_threads(count, function, (self.pointer,), self.rows_per_thread)

    def drive(self, decide: Callable[..., int], count: int) -> None:
        """Call the kernel's ``decide`` on the first ``count`` of ``rows``."""
        batch = self.batch
        pointers = (batch.settings, batch.inputs, batch.outputs)
        in_threads(count, decide, pointers, self.rows_per_thread)


class NativeBatch:
    """N highways as ``config`` describes them.

    Args:
        config: with an observation of :data:`ganlane.native.settings.NATIVE_FORMS` and without
            sensor errors.
        drivers: the others, and how the ego follows.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.

    Attributes:
        rows: N.
        terms: names of the reward's terms.
        bounds: of the observation's numbers but the first, which is from 0 to
            :data:`SPEED_RATIO_LIMIT`.
        state: the environment's state (:mod:`ganlane.keys`) as arrays by key, ``("vehicles", "x")``
            [N, M], ``("ego", "distance")`` and the rest [N].
        observation: [N, D] float32.
        mask: the actions allowed now, [N, A] bool; [N, 0] where actions are not numbered.
        time_s: since the start of the episode [N].
        lane: that the ego is in [N], from 0 at the right; of an ego off the road the outer one.

    All arrays are made once. :meth:`start`, :meth:`restart` and :meth:`step` overwrite them.

    Raises:
        UserError: the kernel cannot be built here.
    """

    def __init__(self, config: HighwayConfig, drivers: Drivers, variant: str | None = None) -> None:
        self.config = config
        # For copies and other processes, which make the batch anew.
        self._arguments = (config, drivers, variant)
        self.rows = config.num_envs
        self.terms = config.reward.term_names

        env = config.env
        self._highway = Highway(
            lanes=env.lanes,
            lane_width_m=env.lane_width_m,
            vehicles=env.vehicles,
            stretches=env.stretches(),
            flow=env.flow if env.flow.is_on else None,
            actions=env.actions,
        )

        # Bounds of the observation's numbers; some count metres of the longest vehicle.
        form = config.observation.form
        scene = env.scenes()
        longest_m = env.spawn_parameters().longest_m if scene is None else scene.longest_m
        self.bounds = (-1.0, largest_number(form, longest_m))

        view = settings.view_of(self._highway, config.observation, form)
        self._make_arrays(drivers, view.numbers())

        # Few rule-driven rows are quicker in narrow vectors. A network fills the widest ones with
        # its own numbers, whatever the rows.
        widest = variant or by_network(drivers)
        self._library = load(variant) if widest else load_for(self.rows)

        # Of several parts of the drivers each drives the rows that are its own, by episode.
        self._turns = np.array(turns_of(drivers))
        common = self._common_members(drivers, view)
        self._parts = [self._part_of(part, common) for part in parts_of(drivers)]

        # The arrays stay where they are, so every step returns the same ones.
        self._stepped = Stepped(
            self.observation,
            self.state[keys.REWARD],
            self.state["terminated"],
            self.state["truncated"],
        )

    def _make_arrays(self, drivers: Drivers, size: int) -> None:
        """All arrays in place, written by the kernel and read by whoever asks.

        ``size`` is the length D of an observation.
        """
        rows = self.rows
        actions = self._highway.actions

        # The state, with the memory of the drivers of all parts.
        layout = Layout(drivers.memory(), self._highway)
        kinds = layout.kinds | _ROW_ARRAYS
        self.state: dict[Key, Array] = {}
        for name, kind in kinds.items():
            shape = layout.shape(name, rows, self._highway.vehicles)
            self.state[name] = np.zeros(shape, kind)

        # What the ego is commanded: numbered actions [N], or continuous controls [N, 2].
        self._commands = self.state[keys.ACTION]
        if not actions.names:
            self._commands = np.zeros((rows, CONTROLS), np.float32)
            self.state["controls"] = self._commands

        self.observation = np.zeros((rows, size), np.float32)

        # Of the paper's actions [N, 3], and of all actions [N, A] where there are others.
        self._lane_mask = np.ones((rows, keys.ACTIONS), np.bool_)
        self.mask = self._lane_mask
        if actions.form != LANE:
            self.mask = np.ones((rows, len(actions.names)), np.bool_)
        # The kernel's function of the mask has a second result, which nobody reads here.
        self._no_safe_action = np.zeros(rows, np.bool_)

        self.time_s = np.zeros(rows)
        self.lane = np.zeros(rows, np.int64)

        # [N, terms], and a view of the first row.
        self._term_values = np.zeros((rows, len(self.terms)), np.float32)
        self._first_terms = self._term_values[0]

    def _common_members(self, drivers: Drivers, view: settings.View) -> dict[str, Any]:
        """The members of :class:`_Batch` that all parts share."""
        config = self.config
        highway = self._highway
        abort = config.env.ego.abort_lane_change

        reward = vars(config.reward) | {
            "decision_period_s": config.env.episode_parameters().decision_period_s,
            "terms": len(self.terms),
        }

        return highway._asdict() | {
            # The start of an episode.
            "scene": self._pointers(settings.STARTS),
            # The reward, its terms by themselves.
            "reward_settings": filled(settings.Reward, reward),
            "reward": self.state[keys.REWARD],
            "terms": self._term_values,
            # The observation, and the bounds it is cut off at: of the speed, and of all others.
            "view": view,
            "view_inputs": self._pointers(_VIEWS),
            "observation": self.observation,
            "size": view.numbers(),
            "fastest": SPEED_RATIO_LIMIT,
            "lowest": self.bounds[0],
            "highest": self.bounds[1],
            # The mask, of the paper's actions and with those of the speed.
            "mask_settings": mask_settings(highway, drivers.idm, config.mask, abort),
            "mask_inputs": self._pointers(_MASKS),
            "mask_outputs": addresses([self._lane_mask, self._no_safe_action]),
            "mask": self._lane_mask,
            "speed_mask": self.mask if highway.actions.form == LANE_SPEED else None,
            "mask_form": MASKS.index(config.mask.form),
            "abort_lane_change": abort,
            # Of gymnasium's info.
            "time_s": self.time_s,
            "lane": self.lane,
        }

    def _part_of(self, part: DriverPart, common: dict[str, Any]) -> _Part:
        """What drives the rows of a part of the drivers."""
        env = self.config.env
        highway = self._highway

        # The share of the episodes in which vehicles left behind come back ahead. With a flow
        # vehicles enter and leave in every episode instead.
        recycle_share = env.recycle_share if env.recycle else None
        if highway.flow is not None:
            recycle_share = 1.0

        # When others see the ego's lane changes, and the ego theirs.
        ego_visibility = Visibility.named(env.ego.visibility)
        others_visibility = part.drivers.visibility
        spawn = settings.spawn_of(
            highway,
            env.spawn_parameters(),
            Stream.named(self.config.stream),
            ego_visibility,
            others_visibility,
            recycle_share,
            env.scenes(others_visibility),
        )

        decision = decision_settings(
            highway,
            part.drivers,
            env.episode_parameters(),
            env.ego,
            env.mobil,
        )

        # A single part drives all rows: the kernel gets a null pointer in place of a list.
        row_list = np.zeros(self.rows, np.int64) if len(self._turns) > 1 else None
        layout = Layout(part.memory, highway)
        specific = {
            "settings": decision,
            "inputs": self._pointers(layout.inputs, row_list),
            "outputs": self._pointers(layout.outputs),
            "spawn": spawn,
        }
        batch = filled(_Batch, common | specific)

        return _Part(
            batch=batch,
            pointer=ctypes.byref(batch),
            rows=row_list,
            rows_per_thread=rows_per_thread(part.drivers),
        )

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
        """All that changes from step to step and that somebody reads."""
        return [
            *self.state.values(),
            self.observation,
            self.mask,
            self._term_values,
            self.time_s,
            self.lane,
        ]

    def _pointers(
        self, names: Iterable[Key], rows: Array | None = None
    ) -> ctypes.Array[ctypes.c_void_p]:
        """Addresses of arrays of the state, null for those that it lacks.

        The array named ``"rows"`` is ``rows``.
        """
        arrays: dict[Key, Any] = {**self.state, "rows": rows}
        return addresses([arrays.get(name) for name in names])

    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        """Begin episodes in all rows.

        Args:
            seed, episode: whole numbers from 0, [N], or one for all rows.
        """
        self.state[keys.SEED][:] = seed
        self.state[keys.EPISODE][:] = episode
        self._start(np.ones(self.rows, np.bool_))

    def restart(self, rows: npt.NDArray[np.bool_]) -> None:
        """Begin the next episode, number n + N after n, in the rows where ``rows`` [N] is true."""
        episode = self.state[keys.EPISODE]
        np.add(episode, self.rows, out=episode, where=rows)
        self._start(rows)

    def _start(self, rows: npt.NDArray[np.bool_]) -> None:
        """Begin the episodes that the counters name, in the rows where ``rows`` [N] is true."""
        # The kernel starts the rows whose flag is set and leaves the others alone.
        fresh = self.state["fresh"]
        for number, part in enumerate(self._parts):
            if part.rows is None:
                fresh[:] = rows
            else:
                # Of several parts each starts its own rows.
                fresh[:] = rows & (self._part_of_row() == number)
            part.call(self._library.ganlane_start, self.rows)

    def _part_of_row(self) -> npt.NDArray[np.int64]:
        """Which part drives each row, [N]; parts take turns with the episodes."""
        return self._turns[self.state[keys.EPISODE] % len(self._turns)]

    def step(self, actions: Array) -> Stepped:
        """One decision of every row; no row is reset.

        Args:
            actions: numbers of actions [N], or continuous controls [N, 2] from -1 to 1.

        Raises:
            ValueError: a number that no action has, or a control that is not finite.
            MemoryError: there is no memory for the kernel's own arrays.
        """
        # Copied, since the kernel holds the address of this array.
        self._commands[:] = actions
        if len(self._parts) == 1:
            self._parts[0].call(self._library.ganlane_step, self.rows)
            return self._stepped

        # Each part drives its rows, listed at the front of its array.
        part_of_row = self._part_of_row()
        for number, part in enumerate(self._parts):
            chosen = np.flatnonzero(part_of_row == number)
            assert part.rows is not None
            part.rows[: len(chosen)] = chosen
            part.drive(self._library.ganlane_decide, len(chosen))
        # Reward, mask and observation do not depend on who drove.
        self._parts[0].call(self._library.ganlane_judge, self.rows)
        return self._stepped

    def first_reward_terms(self) -> dict[str, float]:
        """The terms of the last reward of the first row, by name."""
        return dict(zip(self.terms, self._first_terms.tolist()))

    def reward_terms(self) -> dict[str, Floats]:
        """The terms of the last reward by name, each [N]."""
        return dict(zip(self.terms, self._term_values.T))
