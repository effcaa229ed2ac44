"""Highways for gymnasium by the native kernel, without torch."""

# ruff: noqa: D102 - Rows has the docstrings of the methods
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.gym.rows import (
    ACTION_MASK,
    NO_NUMBERS,
    Flags,
    Floats,
    Integers,
    Rows,
    observation_space,
)
from ganlane.native.batch import NativeBatch, Stepped
from ganlane.native.drivers import drivers_of, pays
from ganlane.native.library import why_not
from ganlane.native.settings import NATIVE_FORMS, Array, Key
from ganlane.settings.commands import HighwayConfig
from ganlane.settings.episode import Stream


class NativeRows(Rows):
    """N highways by the native kernel.

    All arrays that it gives are the kernel's own, made once and overwritten by every call: nothing
    is copied here.

    Attributes:
        batch: what drives.
    """

    def __init__(self, batch: NativeBatch) -> None:
        self.batch = batch
        self.count = batch.rows
        self.config = batch.config
        self.episode = self.config.env.episode_parameters()

        _, largest = batch.bounds
        self.space = observation_space(batch.observation.shape[1], largest)

        # No recorded scene is driven by the kernel, so none can end.
        self._no_end = np.zeros(self.count, np.bool_)

        # Made once, since all arrays in it are the kernel's own.
        self._info = super().info()

        # Of the first row, for gymnasium's single environment: functions that read its numbers.
        self._read = []
        for name, array in self._info.items():
            if name not in NO_NUMBERS:
                self._read.append((name, array.item))

        # gymnasium's masks are int8. Controls are not numbered, so they have no mask.
        self._first_mask = None
        if self.actions.names:
            self._first_mask = batch.mask[0].view(np.int8)

    def info(self) -> dict[str, Any]:
        return self._info

    def first_info(self) -> dict[str, Any]:
        # What row_of() gives, in a quarter of its time: it took half of a step.
        info = {name: item(0) for name, item in self._read}
        if self._first_mask is not None:
            info[ACTION_MASK] = self._first_mask.copy()
        info[keys.REWARD_TERMS] = self.batch.first_reward_terms()
        return info

    def __getstate__(self) -> tuple[NativeBatch, bool]:
        """Without the views, which a copy has of its own arrays.

        ``copy.deepcopy`` and ``pickle`` would make arrays of them that nothing writes to.
        """
        return self.batch, self.started

    def __setstate__(self, state: tuple[NativeBatch, bool]) -> None:
        batch, started = state
        self.__init__(batch)  # type: ignore[misc]
        self.started = started

    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        self.started = True
        self.batch.start(seed, episode)

    def restart(self, rows: Flags) -> None:
        self.batch.restart(rows)

    def step(self, actions: Integers | Floats) -> Stepped:
        return self.batch.step(actions)

    def observation(self) -> Floats:
        return self.batch.observation

    def mask(self) -> Flags:
        return self.batch.mask

    def array(self, key: Key) -> Array:
        # Only the end of a recorded scene is missing in the kernel's state.
        array = self.batch.state.get(key, self._no_end)

        # Of vehicles [N, M] the ego's.
        if array.ndim > 1:
            return array[:, keys.EGO_INDEX]
        return array

    def driven(self) -> tuple[npt.NDArray[np.float64], Integers]:
        return self.batch.time_s, self.batch.lane

    def reward_terms(self) -> dict[str, Array]:
        return self.batch.reward_terms()


def native_rows(config: HighwayConfig) -> NativeRows | None:
    """The highways of ``config`` by the kernel; None where the tensor code has to drive them.

    Raises:
        UserError: the weights of the traffic are missing, foreign, or do not fit.
    """
    env = config.env
    observation = config.observation
    stream = int(Stream.named(config.stream))
    drivers = drivers_of(config.traffic, env.idm, env.mobil, stream)

    # The traffic says who drives; the rest is what the kernel's observation and scenes can do.
    if (
        drivers is None
        or (env.kernel == "auto" and not pays(drivers))
        or env.kernel == "torch"
        or observation.form not in NATIVE_FORMS
        or observation.sensors is not None
        or config.device != "cpu"
        # Asked last, since it may build a library.
        or why_not() is not None
    ):
        return None
    return NativeRows(NativeBatch(config, drivers))
