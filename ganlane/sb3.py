"""The batched highway for stable-baselines3: a ``VecEnv`` of highways stepped together.

::

    from stable_baselines3 import PPO
    import ganlane.sb3

    env = ganlane.sb3.make_vec_env("gan", num_envs=64)
    model = PPO("MlpPolicy", env).learn(200_000)
    print(ganlane.api.evaluate([ganlane.sb3.driver(model), "mobil"], ["gan"], episodes=300))

``SubprocVecEnv`` of single environments costs one process each; this one costs one tensor operation
for all of them. sb3-contrib's ``MaskablePPO`` finds the action masks by itself (``mask="safe"``).
Needs the extra ``sb3``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from ganlane import keys
from ganlane.arguments import seed_number
from ganlane.build import Driver
from ganlane.errors import UserError
from ganlane.gym.vector import HighwayVectorGym

try:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    raise UserError("ganlane.sb3 needs stable-baselines3: pip install 'ganlane[sb3]'.") from error

Floats = npt.NDArray[np.float32]
Indices = int | Iterable[int] | None
#: Methods that give one result for each row.
_OF_ROWS = ("action_masks", "render")


class HighwayVecEnv(VecEnv):
    """A batch of highways behind stable-baselines3's interface; made by :func:`make_vec_env`.

    A row that ends begins its next episode in the same step. Its info then holds
    ``terminal_observation``, ``TimeLimit.truncated``, ``episode`` as SB3's ``Monitor`` gives it
    (``r`` return, ``l`` decisions, ``t`` seconds driven), and what :mod:`ganlane.gym` reports of
    the final state (docs/gymnasium.md); other rows have empty infos.

    ``seed(s)`` makes the next reset begin episode i of seed s in row i;
    ``set_options({"episode": k})`` begins k + i.

    Args:
        highways: the batch, as ``gymnasium.make_vec("ganlane/Highway-v0")`` makes it.
    """

    def __init__(self, highways: HighwayVectorGym) -> None:
        self.highways = highways
        # stable-baselines3 splits a step in two: step_async() only stores the actions.
        self._actions: Any = None
        # Sums over the running episode of every row, for the infos that Monitor would give.
        self._return = np.zeros(highways.num_envs)
        self._length = np.zeros(highways.num_envs, dtype=np.int64)
        # The constructor of VecEnv asks for render_mode through get_attr(), so highways is set
        # first.
        super().__init__(
            highways.num_envs,
            highways.single_observation_space,
            highways.single_action_space,
        )

    def reset(self) -> Floats:
        """First observations [N, D] of the next episodes."""
        # SB3 keeps seeds and options for the next reset and clears them after it.
        observation, _ = self.highways.reset(seed=self._seeds[0], options=self._options[0] or None)
        self._reset_seeds()
        self._reset_options()
        self._return[:] = 0.0
        self._length[:] = 0
        return observation

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Store the actions [N] for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Floats, Floats, npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """One decision in every row: observations [N, D], rewards [N], ends [N], infos."""
        observation, reward, terminated, truncated, info = self.highways.step(self._actions)
        self._return += reward
        self._length += 1
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        # SB3 bootstraps from the last observation of a row that was cut off, not of one that ended.
        for row in np.flatnonzero(done):
            infos[row] = self._final_info(int(row), info)
            infos[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
        # The rows that ended are already in their next episode here.
        self._return[done] = 0.0
        self._length[done] = 0
        return observation, reward.astype(np.float32), done, infos

    def _final_info(self, row: int, info: dict[str, Any]) -> dict[str, Any]:
        """What an ended row reports: gymnasium's info but for the terms of the reward."""
        # Whatever is nested, the terms of the reward, is left out.
        final = {}
        for name, values in info["final_info"].items():
            if not isinstance(values, dict):
                final[name] = values[row]
        final["terminal_observation"] = info["final_obs"][row]
        final["episode"] = {
            "r": float(self._return[row]),
            "l": int(self._length[row]),
            "t": float(final["time_s"]),
        }
        return final

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed of the next reset; one for all rows, which drive different episodes of it."""
        # VecEnv wants one seed per row; reset() reads the first only.
        self._seeds = [None if seed is None else seed_number(seed)] * self.num_envs
        return self._seeds

    def action_masks(self) -> npt.NDArray[np.bool_]:
        """Which actions are allowed now, bool [N, 3]."""
        return self.highways.action_masks()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of the batch, once per row."""
        return [getattr(self.highways, attr_name) for _ in self._get_indices(indices)]

    def set_attr(
        self,
        attr_name: str,
        value: Any,
        indices: Indices = None,
    ) -> None:
        """Refused: the rows are one batch and have no attributes of their own.

        Raises:
            UserError: always.
        """
        raise UserError(
            f"set_attr({attr_name!r}): the highways are one batch; give options to make_vec_env()."
        )

    def env_method(
        self, method_name: str, *args: Any, indices: Indices = None, **kwargs: Any
    ) -> list[Any]:
        """The results of a method in the rows ``indices``: ``action_masks`` or ``render``.

        Raises:
            UserError: no such method.
        """
        # A method of the batch that gives no list of rows cannot be split by rows.
        if method_name not in _OF_ROWS:
            names = " and ".join(_OF_ROWS)
            raise UserError(
                f"env_method({method_name!r}): the rows have {names}; call one of them."
            )
        # For all rows at once, of which those asked for are picked.
        results = getattr(self.highways, method_name)(*args, **kwargs)
        return [results[row] for row in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """True only for ``Monitor``, whose episode statistics are in the infos."""
        # evaluate_policy() of stable-baselines3 asks for it, and warns where Monitor is missing.
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """A picture of every row; needs ``render_mode="rgb_array"``."""
        return list(self.highways.render() or ())

    def close(self) -> None:
        """Release what the batch holds."""
        self.highways.close()


def make_vec_env(
    traffic: Any = "idm_mobil", num_envs: int = 64, seed: int | None = None, **options: Any
) -> HighwayVecEnv:
    """N highways for stable-baselines3.

    Args:
        traffic: ``idm``, ``idm_mobil``, ``gan``, ``mixed``, ..., or a traffic module of your own.
        num_envs: N, highways side by side.
        seed: of the episodes; None: drawn at random.
        options: as in :class:`ganlane.gym.vector.HighwayVectorGym`: ``observation``, ``reward``,
            ``mask``, ``stream``, ``render_mode``, and single keys of the environment such as
            ``lanes=4``.

    Raises:
        UserError: a wrong value.
    """
    return HighwayVecEnv(HighwayVectorGym(num_envs=num_envs, traffic=traffic, seed=seed, **options))


class ModelPolicy(TensorDictModuleBase):
    """The deterministic policy of a stable-baselines3 model.

    It writes ``action`` [N] for ``observation`` [N, D].

    Args:
        model: trained on :func:`make_vec_env`; one with masks (sb3-contrib's) is given
            ``action_mask`` [N, 3].
    """

    out_keys = [keys.ACTION]  # noqa: RUF012
    # Nothing is held per row, so an evaluation may move running episodes to other rows.
    rows_must_stay = False

    def __init__(self, model: BaseAlgorithm) -> None:
        super().__init__()
        self.model = model
        # sb3-contrib's MaskablePPO and its kin take masks; SB3's own algorithms do not.
        self._masked = type(model).__name__.startswith("Maskable")
        self.in_keys = [keys.OBSERVATION, keys.ACTION_MASK] if self._masked else [keys.OBSERVATION]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        masks = {}
        if self._masked:
            masks["action_masks"] = tensordict.get(keys.ACTION_MASK).cpu().numpy()
        # stable-baselines3 takes NumPy arrays in main memory, whatever device the model is on.
        observation = tensordict.get(keys.OBSERVATION).cpu().numpy()
        chosen, _ = self.model.predict(observation, deterministic=True, **masks)
        action = torch.as_tensor(chosen, device=tensordict.device)
        return tensordict.set(keys.ACTION, action.long())


def driver(model: BaseAlgorithm, name: str | None = None) -> Driver:
    """A trained model as a driver for ``ganlane.api.evaluate`` and ``ganlane.api.render``.

    It reads the observation of the evaluation, by default the one that :func:`make_vec_env` uses by
    default.

    Args:
        model: PPO, DQN, MaskablePPO, ...; behind a mask, give ``mask="safe"`` to the evaluation,
            too.
        name: in tables; None: the algorithm's, in lower case.
    """
    return Driver(name or type(model).__name__.lower(), ModelPolicy(model))
