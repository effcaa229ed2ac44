"""Every traffic for gymnasium, by the TorchRL environment behind NumPy arrays."""

# ruff: noqa: D102 - Rows has the docstrings of the methods
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from ganlane import keys
from ganlane.agents.drivers import legal_actions
from ganlane.build import make_highways
from ganlane.gym.rows import Flags, Floats, Integers, Rows, observation_space
from ganlane.keys import EGO_INDEX
from ganlane.native.batch import Stepped
from ganlane.native.settings import Array, Key
from ganlane.settings.commands import HighwayConfig
from ganlane.settings.observation import largest_number
from ganlane.sim.state import Road, road_in


class TensorRows(Rows):
    """N highways by the TorchRL environment.

    Attributes:
        env: the TorchRL environment of the settings, with a user's own transforms at the end.
        state: of its rows, from the first :meth:`start` on.
    """

    def __init__(self, config: HighwayConfig, transforms: Sequence[Transform] = ()) -> None:
        self.config = config
        self.transforms = transforms
        self.count = config.num_envs

        self.env = make_highways(config)
        for transform in transforms:
            self.env.append_transform(transform)
        # The simulator below all transforms.
        base = self.env.base_env
        self.episode = base.episode

        size = self.env.observation_spec[keys.OBSERVATION].shape[-1]
        # One form counts metres of overlap, so its bound follows from the longest vehicle.
        largest = largest_number(config.observation.form, base.scenes.longest_m)
        self.space = observation_space(size, largest)

    state: TensorDictBase

    @torch.no_grad()
    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        counters = TensorDict({}, [self.count], device=self.env.device)
        for name, value in {keys.SEED: seed, keys.EPISODE: episode}.items():
            # One number for all rows, or one for each: [N].
            numbers = np.broadcast_to(value, self.count).astype(np.int64)
            counters[name] = torch.as_tensor(numbers, device=self.env.device)
        self.state = self.env.reset(counters)
        self.started = True

    @torch.no_grad()
    def restart(self, rows: Flags) -> None:
        # TorchRL resets where its flag [N, 1] is set, and leaves the other rows alone.
        mask = torch.as_tensor(rows, device=self.env.device)[:, None]
        flagged = self.now().set("_reset", mask)
        self.state = self.env.reset(flagged)

    @torch.no_grad()
    def step(self, actions: Integers | Floats) -> Stepped:
        action = torch.as_tensor(actions, device=self.env.device)
        commanded = self.now().set(keys.ACTION, action)
        stepped = self.env.step(commanded)
        # Rows are not reset here: the environments above decide when.
        self.state = self.env.step_mdp(stepped)

        # TorchRL's rewards and ends are [N, 1], gymnasium's [N].
        names = (keys.REWARD, "terminated", "truncated")
        reward, *ends = (_array(stepped["next", name][:, 0]) for name in names)
        return Stepped(self.observation(), reward.astype(np.float32), *ends)

    def now(self) -> TensorDictBase:
        """The state of all rows; raises :class:`UserError` before the first :meth:`start`."""
        self.check_started()
        return self.state

    def observation(self) -> Floats:
        observation = _array(self.now().get(keys.OBSERVATION))
        # A speed far above the desired one would leave the space.
        return np.clip(observation, self.space.low, self.space.high)

    def mask(self) -> Flags:
        state = self.now()
        # An environment with a mask has computed it; without one it is the actions on the road.
        mask = state.get(keys.ACTION_MASK, None)
        if mask is None:
            mask = legal_actions(state, self._road(), self.actions)
        return _array(mask)

    def array(self, key: Key) -> Array:
        array = _array(self.now().get(key))
        # The ego is the first vehicle; events have the shape [N, 1].
        return array[:, EGO_INDEX] if array.ndim > 1 else array

    def driven(self) -> tuple[npt.NDArray[np.float64], Integers]:
        # Counted in physics steps, so that it has no sum of rounding errors.
        time_s = self.array(keys.STEP) * keys.PHYSICS_STEP_S
        road = self._road()
        # One number for all rows, or [N, 1].
        lanes, width_m = (
            _array(torch.as_tensor(number).flatten()) for number in (road.lanes, road.lane_width_m)
        )
        y = self.array((keys.VEHICLES, "y"))
        # The road's own rounding, in the run's float type.
        lane = np.rint(y / width_m.astype(y.dtype))
        lane = np.minimum(np.maximum(lane, 0.0), lanes - 1)
        return time_s, lane.astype(np.int64)

    def _road(self) -> Road:
        """The road of the rows: of their recorded scenes, else that of the settings."""
        return road_in(self.now(), self.env.base_env.road)

    def reward_terms(self) -> dict[str, Array]:
        terms = self.now().get(keys.REWARD_TERMS).items()
        return {name: _array(term[:, 0]) for name, term in terms}


def _array(tensor: Tensor) -> npt.NDArray[Any]:
    """As NumPy array, on a CPU without a copy."""
    return tensor.cpu().numpy()
