"""Rule-driven traffic for gymnasium: the native kernel on NumPy arrays, without torch and TorchRL."""

# ruff: noqa: D102 - Rows has the docstrings of the methods
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.config.commands import RunConfig
from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.gym.rows import Flags, Floats, Rows, observation_space
from ganlane.keys import PHYSICS_STEP_S
from ganlane.native.batch import NativeBatch, Stepped
from ganlane.native.settings import NATIVE_FORMS
from ganlane.options import Option, option
from ganlane.parameters.episode import EpisodeParameters, Stream

#: Traffic that the kernel implements, and whether it changes lanes.
_TRAFFICS = {"ganlane.traffic.IdmTraffic": False, "ganlane.traffic.IdmMobilTraffic": True}
_OPTIONS = ("env", "observation", "reward", "mask", "stream", "device", "transforms")


def native_rows(traffic: Option, count: int, options: dict[str, Any]) -> NativeRows | None:
    """N highways by the kernel; None where it does not implement these options, or one of them is wrong.

    The arguments are those of :func:`ganlane.gym.rows.make_rows`.
    """
    given = {name: options.pop(name) for name in _OPTIONS if name in options}
    try:
        config: TrafficConfig = option("traffic", traffic)
        env: EnvConfig = option("env", given.get("env"), options)
        observation, reward, mask = (option(group, given.get(group)) for group in ("observation", "reward", "mask"))
        check_reward(env, reward)
        device = RunConfig(device=given.get("device", "cpu")).device
        stream = Stream.named(str(given.get("stream", "train")))
    except UserError:
        return None  # TensorRows reports the mistake
    implemented = (
        config._target_ in _TRAFFICS and not config.blind_share and not config.parameters
        and observation.form in NATIVE_FORMS and observation.sensors is None
        and type(env).scenes is EnvConfig.scenes and env.kernel != "torch"
        and isinstance(count, int) and 1 <= count <= 65536
        and device == "cpu" and not len(given.get("transforms", ()))
    )  # fmt: skip
    if not implemented:
        return None
    batch = NativeBatch(
        count,
        env.lanes,
        env.lane_width_m,
        env.vehicles,
        env.spawn_parameters(),
        env.ego,
        env.episode_parameters(),
        env.idm,
        env.mobil if _TRAFFICS[config._target_] else None,
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
        lane = np.rint(state["y"][:, 0] / np.float32(batch.lane_width_m)).astype(np.int64)
        return {
            "seed": state["seed"],
            "episode_number": state["episode"],
            "time_s": state["step"] * PHYSICS_STEP_S,
            "distance_m": state["distance"],
            "speed_mps": state["speed"][:, 0],
            "lane": np.minimum(np.maximum(lane, 0), batch.lanes - 1),
            "decisions": state["decisions"],
            "lane_changes": state["lane_changes"],
            "action_mask": batch.mask.view(np.int8),
            "goal": state["goal"],
            "hard_crash": state["hard_crash"],
            "out_of_road": state["out_of_road"],
            "timeout": state["timeout"],
            "scene_end": self._never,
            keys.SOFT_CRASH: state["soft_crashes"],
            keys.SOFT_CRASH_BEHIND: state["soft_crashes_behind"],
            keys.REWARD_TERMS: batch.reward_terms(),
        }
