"""A batch of TorchRL environments as NumPy arrays, and checks of the arguments of reset and step.

Both environments, single and vector, stand on this module.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.agents.drivers import legal_actions
from ganlane.errors import UserError
from ganlane.keys import ACTIONS, EGO_INDEX, PHYSICS_STEP_S
from ganlane.sim.state import road_in
from ganlane.transforms import ObservationTransform, largest_number

Floats = npt.NDArray[np.float32]
#: Speed over desired speed beyond which the observation is cut off, for a space with bounds; IDM stays far below.
SPEED_RATIO_LIMIT: Final = 4.0
#: Unseeded environments draw their seed below this.
SEEDS: Final = 2**31


def observation_space(env: TransformedEnv) -> Box:
    """Bounds of the observation [D]: speed over desired speed, then numbers from -1 to the largest of its form."""
    size = env.observation_spec[keys.OBSERVATION].shape[-1]
    form = next((each.form for each in env.transform if isinstance(each, ObservationTransform)), "table3")
    largest = largest_number(form, env.base_env.scenes.longest_m)
    low, high = np.full(size, -1.0, np.float32), np.full(size, largest, np.float32)
    low[0], high[0] = 0.0, SPEED_RATIO_LIMIT
    return Box(low, high, dtype=np.float32)


class Rows:
    """N rows of an environment from :func:`ganlane.api.make_env`, and their state."""

    def __init__(self, env: TransformedEnv) -> None:
        self.env, self.count = env, env.batch_size[0]
        self.space = observation_space(env)
        self.state: TensorDictBase | None = None

    @torch.no_grad()
    def start(self, seed: npt.ArrayLike, episode: npt.ArrayLike) -> None:
        """Begin the episodes [N] of the seeds [N]; each may be one number for all rows."""
        numbers = {keys.SEED: seed, keys.EPISODE: episode}
        counters = {
            name: torch.as_tensor(np.broadcast_to(value, self.count).astype(np.int64), device=self.env.device)
            for name, value in numbers.items()
        }
        self.state = self.env.reset(TensorDict(counters, [self.count], device=self.env.device))

    @torch.no_grad()
    def step(self, actions: Tensor) -> TensorDictBase:
        """One decision; the state after it, which is kept. No row is reset."""
        stepped = self.env.step(self._with(actions))
        self.state = self.env.step_mdp(stepped)
        return stepped.get("next")

    @torch.no_grad()
    def step_and_reset(self, actions: Tensor) -> TensorDictBase:
        """One decision; the state after it. The state that is kept has the next episodes of rows that ended."""
        stepped, self.state = self.env.step_and_maybe_reset(self._with(actions))
        return stepped.get("next")

    @torch.no_grad()
    def restart(self, rows: npt.NDArray[np.bool_]) -> None:
        """Go on to the next episode in some rows [N]."""
        mask = torch.as_tensor(rows, device=self.env.device)[:, None]
        self.state = self.env.reset(self.now().set("_reset", mask))

    def now(self) -> TensorDictBase:
        """The state of all rows."""
        if self.state is None:
            raise UserError("no episode is under way; call reset() first.")
        return self.state

    def _with(self, actions: Tensor) -> TensorDictBase:
        return self.now().set(keys.ACTION, actions.to(self.env.device))

    def observation(self, state: TensorDictBase | None = None) -> Floats:
        """Observations [N, D], a copy, within the space."""
        found = (self.now() if state is None else state).get(keys.OBSERVATION)
        return np.clip(found.cpu().numpy(), self.space.low, self.space.high)

    def allowed(self) -> npt.NDArray[np.bool_]:
        """Which actions are allowed now, [N, 3]; a copy."""
        return _array(self._mask(self.now()))

    def _mask(self, state: TensorDictBase) -> Tensor:
        """The environment's mask, bool [N, 3]; without one, the actions that stay on the road."""
        mask = state.get(keys.ACTION_MASK, None)
        return legal_actions(state, road_in(state, self.env.base_env.road)) if mask is None else mask

    def info(self, state: TensorDictBase | None = None) -> dict[str, Any]:
        """Gymnasium's info: by name (docs/gymnasium.md lists them) arrays [N], the mask [N, 3]; copies."""
        state = self.now() if state is None else state
        vehicles, ego, events = state.get(keys.VEHICLES), state.get(keys.EGO), state.get(keys.EVENTS)
        road = road_in(state, self.env.base_env.road)
        found = {
            "seed": state.get(keys.SEED),
            "episode_number": state.get(keys.EPISODE),
            "time_s": state.get(keys.STEP).double() * PHYSICS_STEP_S,
            "distance_m": ego.get("distance"),
            "speed_mps": vehicles.get("speed")[:, EGO_INDEX],
            "lane": road.lane_of(vehicles.get("y"))[:, EGO_INDEX].long(),
            "decisions": ego.get("decisions"),
            "lane_changes": ego.get("lane_changes"),
            "action_mask": self._mask(state).to(torch.int8),
            **{name: events.get(name)[:, 0] for name in (*keys.END_EVENTS, keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)},
        }
        terms = {name: _array(term[:, 0]) for name, term in state.get(keys.REWARD_TERMS).items()}
        return {**{name: _array(value) for name, value in found.items()}, keys.REWARD_TERMS: terms}


def _array(tensor: Tensor) -> npt.NDArray[Any]:
    return tensor.cpu().numpy().copy()


def row_of(info: dict[str, Any], row: int) -> dict[str, Any]:
    """One row of :meth:`Rows.info`, numbers as plain Python."""
    return {name: _item(value, row) for name, value in info.items()}


def _item(value: Any, row: int) -> Any:
    if isinstance(value, dict):
        return row_of(value, row)
    return value[row].copy() if value.ndim > 1 else value[row].item()


def actions_of(given: Any, rows: int) -> Tensor:
    """A user's actions as a tensor [rows] int64.

    Raises:
        UserError: another shape, or no such action.
    """
    array = np.asarray(given)
    if array.shape != (rows,) or array.dtype.kind not in "iu" or not np.isin(array, range(ACTIONS)).all():
        raise UserError(
            f"action {array.tolist()}: expected {rows} whole number(s), 0 (keep), 1 (left) or 2 (right); give one "
            "for every environment."
        )
    return torch.as_tensor(array.astype(np.int64))


def known_options(options: dict[str, Any] | None, names: tuple[str, ...]) -> dict[str, Any]:
    """The options of a reset, checked for unknown names."""
    if not isinstance(options, dict | None):
        raise UserError(f"options={options!r}: expected a dictionary with {', '.join(names)}, or none.")
    unknown = sorted(map(str, set(options or {}) - set(names)))
    if unknown:
        raise UserError(f"options: {', '.join(unknown)} unknown; a reset takes {', '.join(names)}.")
    return dict(options or {})


def episode_numbers(episode: Any) -> npt.NDArray[np.int64]:
    """The option ``episode``, checked: whole numbers from 0, one or several."""
    numbers = np.asarray(episode)
    if numbers.dtype.kind not in "iu" or (numbers < 0).any():
        raise UserError(f"options: episode={episode!r}: expected whole numbers from 0; give for instance 3.")
    return numbers.astype(np.int64)


def row_mask(mask: Any, rows: int) -> npt.NDArray[np.bool_]:
    """The option ``reset_mask``, checked: a boolean array [rows]."""
    array = np.asarray(mask)
    if array.shape != (rows,) or array.dtype != np.bool_:
        raise UserError(
            f"options: reset_mask: expected a boolean array of shape ({rows},); give one flag for every row."
        )
    return array
