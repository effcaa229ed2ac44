"""Rule-driven traffic for gymnasium: the native kernel on NumPy arrays, without torch and TorchRL."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ganlane import keys
from ganlane.config.env import EnvConfig, check_reward
from ganlane.config.run import RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.gym.rows import Flags, Floats, Rows, observation_space
from ganlane.keys import PHYSICS_STEP_S
from ganlane.native.batch import NativeBatch, Stepped
from ganlane.native.settings import NATIVE_FORMS
from ganlane.options import Option, option
from ganlane.parameters.episode import EpisodeParameters, Stream

#: What the kernel drives, and whether it changes lanes.
_TRAFFICS = {"ganlane.traffic.IdmTraffic": False, "ganlane.traffic.IdmMobilTraffic": True}
_OPTIONS = ("env", "observation", "reward", "mask", "stream", "device", "transforms")


def native_rows(traffic: Option, count: int, options: dict[str, Any]) -> NativeRows | None:
    """N highways by the kernel; None where it cannot do what is asked, or something is wrong with it.

    Arguments as those of :func:`ganlane.gym.rows.make_rows`.
    """
    own = {name: options.pop(name) for name in _OPTIONS if name in options}
    try:
        chosen: TrafficConfig = option("traffic", traffic)
        env: EnvConfig = option("env", own.get("env", "highway"), options)
        observation = option("observation", own.get("observation", "lane_view_overlap"))
        reward, mask = option("reward", own.get("reward", "paper")), option("mask", own.get("mask", "none"))
        check_reward(env, reward)
        device = RunConfig(device=own.get("device", "cpu")).device
        stream = Stream.named(str(own.get("stream", "train")))
    except UserError:
        return None  # the other way says what is wrong
    ruled = chosen._target_ in _TRAFFICS and not chosen.blind_share and not chosen.parameters
    seen = observation.form in NATIVE_FORMS and observation.sensors is None
    random_scenes = type(env).scenes is EnvConfig.scenes and env.kernel != "torch"
    whole = isinstance(count, int) and 1 <= count <= 65536
    if not (ruled and seen and random_scenes and whole) or device != "cpu" or len(own.get("transforms", ())):
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
        env.mobil if _TRAFFICS[chosen._target_] else None,
        env.recycle_share if env.recycle else None,
        observation,
        reward,
        mask,
        int(stream),
    )
    return NativeRows(batch, env.episode_parameters())


class NativeRows(Rows):
    """See :class:`ganlane.gym.rows.Rows`."""

    def __init__(self, batch: NativeBatch, episode: EpisodeParameters) -> None:
        self.batch, self.count, self.episode = batch, batch.rows, episode
        self.space = observation_space(batch.observation.shape[1], batch.bounds[1])
        self._started = False
        self._never = np.zeros(batch.rows, np.bool_)

    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        """See :class:`ganlane.gym.rows.Rows`."""
        self._started = True
        self.batch.start(seed, episode)

    def restart(self, rows: Flags) -> None:
        """See :class:`ganlane.gym.rows.Rows`."""
        state = self.batch.state
        self.batch.start(state["seed"], state["episode"] + self.count, rows)

    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        """See :class:`ganlane.gym.rows.Rows`."""
        return self.batch.step(actions)

    def observation(self) -> Floats:
        """See :class:`ganlane.gym.rows.Rows`."""
        return self.batch.observation

    def mask(self) -> Flags:
        """See :class:`ganlane.gym.rows.Rows`."""
        return self.batch.mask

    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
        """See :class:`ganlane.gym.rows.Rows`."""
        state = self.batch.state
        return (state["seed"], state["episode"]) if self._started else None

    def info(self) -> dict[str, Any]:
        """See :class:`ganlane.gym.rows.Rows`."""
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
