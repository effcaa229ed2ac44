"""Rule-driven traffic for gymnasium, by the native kernel and without torch."""

# ruff: noqa: D102 - Rows has the docstrings of the methods
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.settings.commands import RunConfig
from ganlane.settings.env import EnvConfig, check_reward
from ganlane.settings.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.gym.rows import Flags, Floats, Integers, Rows, observation_space
from ganlane.native.batch import NativeBatch, Stepped
from ganlane.native.settings import NATIVE_FORMS
from ganlane.options import Option, option
from ganlane.settings.episode import EpisodeParameters, Stream

#: Options of :func:`ganlane.api.make_env` that are no keys of the environment.
_GROUPS = ("env", "observation", "reward", "mask", "stream", "device", "transforms")


class NativeRows(Rows):
    """N highways by the native kernel."""

    def __init__(self, batch: NativeBatch, episode: EpisodeParameters) -> None:
        self.batch, self.count, self.episode = batch, batch.rows, episode
        self.space = observation_space(batch.observation.shape[1], batch.bounds[1])
        # Made once, since they are views of arrays that the kernel writes to.
        state = batch.state
        self._arrays: dict[str, Any] = {
            **state,
            "y": state["y"][:, keys.EGO_INDEX],
            "speed": state["speed"][:, keys.EGO_INDEX],
            "scene_end": np.zeros(batch.rows, np.bool_),
            keys.SOFT_CRASH: state["soft_crashes"],
            keys.SOFT_CRASH_BEHIND: state["soft_crashes_behind"],
            "lanes": batch.lanes,
            "lane_width_m": batch.lane_width_m,
            keys.REWARD_TERMS: batch.reward_terms(),
        }

    def __getstate__(self) -> tuple[NativeBatch, EpisodeParameters, bool]:
        """Without the views, which a copy has of its own arrays."""
        return self.batch, self.episode, self.started

    def __setstate__(self, state: tuple[NativeBatch, EpisodeParameters, bool]) -> None:
        self.__init__(*state[:2])  # type: ignore[misc]
        self.started = state[2]

    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        self.started = True
        self.batch.start(seed, episode)

    def restart(self, rows: Flags) -> None:
        state = self.batch.state
        self.batch.start(state["seed"], state["episode"] + self.count, rows)

    def step(self, actions: Integers) -> Stepped:
        return self.batch.step(actions)

    def observation(self) -> Floats:
        return self.batch.observation

    def mask(self) -> Flags:
        return self.batch.mask

    def state_arrays(self) -> Mapping[str, Any]:
        return self._arrays


def native_rows(traffic: Option, count: int, options: Mapping[str, Any]) -> NativeRows | None:
    """N highways with the ``options`` of :func:`ganlane.api.make_env`, by the kernel.

    None where it does not implement them, or one of them is wrong, which is then reported by who
    makes the TorchRL environment.
    """
    groups = {name: options.get(name) for name in _GROUPS}
    of_env = {name: value for name, value in options.items() if name not in _GROUPS}
    try:
        others: TrafficConfig = option("traffic", traffic)
        env: EnvConfig = option("env", groups["env"], of_env)
        observation, reward, mask = (
            option(name, groups[name]) for name in ("observation", "reward", "mask")
        )
        check_reward(env, reward)
        device = RunConfig(device=options.get("device", "cpu")).device
        stream = Stream.named(str(options.get("stream", "train")))
    except UserError:
        return None
    # The traffic says who drives; the rest is what the kernel's observation and scenes can do.
    drivers = others.native_parameters(env)
    if (
        drivers is None
        or env.kernel == "torch"
        or type(env).scenes is not EnvConfig.scenes
        or observation.form not in NATIVE_FORMS
        or observation.sensors is not None
        or device != "cpu"
        or len(options.get("transforms", ()))
    ):
        return None
    episode = env.episode_parameters()
    batch = NativeBatch(
        count,
        env.lanes,
        env.lane_width_m,
        env.vehicles,
        env.spawn_parameters(),
        env.ego,
        episode,
        drivers.idm,
        drivers.mobil,
        env.recycle_share if env.recycle else None,
        observation,
        reward,
        mask,
        int(stream),
    )
    return NativeRows(batch, episode)
