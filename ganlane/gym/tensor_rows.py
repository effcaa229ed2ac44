"""Every traffic for gymnasium, by the TorchRL environment behind NumPy arrays.

Imports torch, which takes seconds: import it only where the native kernel will not do.
"""

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
from ganlane.native.batch import Stepped
from ganlane.native.settings import Array, Key
from ganlane.settings.commands import HighwayConfig
from ganlane.settings.observation import largest_number
from ganlane.sim.state import Road, road_in


class TensorRows(Rows):
    """N highways by the TorchRL environment.

    Args:
        config: the settings of the highways.
        transforms: a user's own, behind those that the settings ask for.

    Attributes:
        env: the TorchRL environment of the settings, with a user's own transforms at the end.
        state: of its rows, from the first :meth:`start` on.

    Raises:
        UserError: a wrong value, or missing weights.
    """

    state: TensorDictBase

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
        # Some forms count metres of overlap, so their bound follows from the longest vehicle.
        largest = largest_number(config.observation.form, base.scenes.longest_m)
        self.space = observation_space(size, largest)

    @torch.no_grad()
    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        counters = TensorDict({}, [self.count], device=self.env.device)
        named = {
            keys.SEED: seed,
            keys.EPISODE: episode,
        }

        for name, value in named.items():
            # One number for all rows, or one for each: [N].
            numbers = np.broadcast_to(value, self.count).astype(np.int64)
            counters[name] = torch.as_tensor(numbers, device=self.env.device)

        # Without a mask the counters name the episodes that begin.
        self.state = self.env.reset(counters)
        self.started = True

    @torch.no_grad()
    def restart(self, rows: Flags) -> None:
        # TorchRL resets where its flag [N, 1] is set, and leaves the other rows alone. The counters
        # of the state are then those of the episodes that have ended: the next ones follow.
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
        after = stepped["next"]
        reward = _array(after[keys.REWARD][:, 0])
        terminated = _array(after["terminated"][:, 0])
        truncated = _array(after["truncated"][:, 0])

        return Stepped(
            self.observation(),
            # A highway in float64 has rewards in float64.
            reward.astype(np.float32),
            terminated,
            truncated,
        )

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

        # Of vehicles [N, M] the ego's, which is the first. Events are [N, 1], where the index of
        # the ego takes off the dimension of one.
        if array.ndim > 1:
            return array[:, keys.EGO_INDEX]
        return array

    def driven(self) -> tuple[npt.NDArray[np.float64], Integers]:
        # Counted in physics steps, so that it has no sum of rounding errors.
        time_s = self.array(keys.STEP) * keys.PHYSICS_STEP_S

        # Of an ego that has left the road it is the outer lane.
        y_m = self.now().get((keys.VEHICLES, "y"))[:, :1]
        lane = self._road().lane_of(y_m)
        return time_s, _array(lane[:, 0].long())

    def _road(self) -> Road:
        """The road of the rows: of their recorded scenes, else that of the settings."""
        return road_in(self.now(), self.env.base_env.road)

    def reward_terms(self) -> dict[str, Array]:
        # TorchRL has them as [N, 1].
        terms = self.now().get(keys.REWARD_TERMS).items()
        return {name: _array(term[:, 0]) for name, term in terms}


def _array(tensor: Tensor) -> npt.NDArray[Any]:
    """As NumPy array, on a CPU without a copy."""
    return tensor.cpu().numpy()
