"""Every traffic for gymnasium: the TorchRL environment behind NumPy arrays."""

# ruff: noqa: D102 - Rows has the docstrings of the methods
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.agents.drivers import legal_actions
from ganlane.api import make_env
from ganlane.gym.rows import Flags, Floats, Rows, observation_space
from ganlane.keys import EGO_INDEX, PHYSICS_STEP_S
from ganlane.native.batch import Stepped
from ganlane.options import Option
from ganlane.parameters.observation import largest_number
from ganlane.sim.state import road_in
from ganlane.transforms import ObservationTransform


class TensorRows(Rows):
    """N highways by the TorchRL environment.

    Args:
        traffic: as in :func:`ganlane.api.make_env`, as are ``options``.
        count: N.
    """

    env: TransformedEnv

    def __init__(self, traffic: Option, count: int, options: Mapping[str, Any]) -> None:
        self.env = env = make_env(traffic, count, **options)
        self.count, self.episode = count, env.base_env.episode
        form = next((each.form for each in env.transform if isinstance(each, ObservationTransform)), "table3")
        largest = largest_number(form, env.base_env.scenes.longest_m)
        self.space = observation_space(env.observation_spec[keys.OBSERVATION].shape[-1], largest)

    @torch.no_grad()
    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        numbers = {keys.SEED: seed, keys.EPISODE: episode}
        counters = {
            name: torch.as_tensor(np.broadcast_to(value, self.count).astype(np.int64), device=self.env.device)
            for name, value in numbers.items()
        }
        self.state = self.env.reset(TensorDict(counters, [self.count], device=self.env.device))

    @torch.no_grad()
    def restart(self, rows: Flags) -> None:
        mask = torch.as_tensor(rows, device=self.env.device)[:, None]
        self.state = self.env.reset(self.now().set("_reset", mask))

    @torch.no_grad()
    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        stepped = self.env.step(self.now().set(keys.ACTION, torch.as_tensor(actions, device=self.env.device)))
        self.state, after = self.env.step_mdp(stepped), stepped.get("next")
        reward, *ended = (_array(after.get(name)[:, 0]) for name in ("reward", "terminated", "truncated"))
        return Stepped(self.observation(), reward.astype(np.float32), *ended)

    def now(self) -> TensorDictBase:
        """The state of all rows; raises :class:`UserError` before the first :meth:`start`."""
        if self.state is None:  # asked first, since check_started copies the numbers from the device
            self.check_started()
        return self.state

    def observation(self) -> Floats:
        return np.clip(self.now().get(keys.OBSERVATION).cpu().numpy(), self.space.low, self.space.high)

    def mask(self) -> Flags:
        state = self.now()
        mask: Tensor | None = state.get(keys.ACTION_MASK, None)
        return _array(legal_actions(state, road_in(state, self.env.base_env.road)) if mask is None else mask)

    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
        state = self.state
        return None if state is None else (_array(state.get(keys.SEED)), _array(state.get(keys.EPISODE)))

    def info(self) -> dict[str, Any]:
        state = self.now()
        vehicles, ego, events = state.get(keys.VEHICLES), state.get(keys.EGO), state.get(keys.EVENTS)
        road = road_in(state, self.env.base_env.road)
        values = {
            "seed": state.get(keys.SEED),
            "episode_number": state.get(keys.EPISODE),
            "time_s": state.get(keys.STEP).double() * PHYSICS_STEP_S,
            "distance_m": ego.get("distance"),
            "speed_mps": vehicles.get("speed")[:, EGO_INDEX],
            "lane": road.lane_of(vehicles.get("y"))[:, EGO_INDEX].long(),
            "decisions": ego.get("decisions"),
            "lane_changes": ego.get("lane_changes"),
            **{name: events.get(name)[:, 0] for name in (*keys.END_EVENTS, keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)},
        }
        terms = {name: _array(term[:, 0]) for name, term in state.get(keys.REWARD_TERMS).items()}
        arrays = {name: _array(value) for name, value in values.items()}
        return {**arrays, "action_mask": self.mask().astype(np.int8), keys.REWARD_TERMS: terms}


def _array(tensor: Tensor) -> npt.NDArray[Any]:
    return tensor.cpu().numpy()
