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

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium import wrappers
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.agents.drivers import ObservationPolicy, mask_in
from ganlane.agents.stored_models import (
    Floats,
    Network,
    Normaliser,
    Reading,
    read_description,
    write_description,
)
from ganlane.arguments import seed_number
from ganlane.build import Driver
from ganlane.errors import ParameterError, UserError
from ganlane.files import atomic_path
from ganlane.gym.base import OnRows
from ganlane.gym.vector import HighwayVectorGym
from ganlane.settings.actions import ActionParameters
from ganlane.settings.observation import MaskParameters, ObservationConfig

try:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import (
        DummyVecEnv,
        VecCheckNan,
        VecEnv,
        VecEnvWrapper,
        VecMonitor,
        VecNormalize,
        VecVideoRecorder,
    )
except ModuleNotFoundError as error:
    raise UserError("ganlane.sb3 needs stable-baselines3: pip install 'ganlane[sb3]'.") from error

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
        arrays = info["final_info"].items()
        final = {name: array[row] for name, array in arrays if not isinstance(array, dict)}
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
        """Which actions are allowed now, bool [N, A]."""
        return self.highways.action_masks()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of the batch, once per row."""
        return [getattr(self.highways, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
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


#: What may stand between a model and the highway, since it changes neither observation nor action.
_TRANSPARENT = (
    HighwayVecEnv,
    DummyVecEnv,
    VecCheckNan,
    VecMonitor,
    VecVideoRecorder,
    Monitor,
    gymnasium.RewardWrapper,
    wrappers.HumanRendering,
    wrappers.NormalizeReward,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
    wrappers.TimeLimit,
)


class ModelPolicy(ObservationPolicy):
    """The deterministic policy of a stable-baselines3 model, for one environment at a time.

    It writes ``action`` [N] for ``observation`` [N, D].

    Args:
        model: one with masks (sb3-contrib's) is given ``action_mask`` [N, 3]; one with a memory
            (``RecurrentPPO``) keeps it for every row until the row's episode is over.
        normaliser: of the observations; its statistics are not updated.
    """

    def __init__(
        self, model: BaseAlgorithm, normaliser: VecNormalize | Normaliser | None = None
    ) -> None:
        super().__init__()
        self.model = model
        self.normaliser = normaliser
        # An evaluation may move running episodes to other rows where nothing is held per row.
        self.rows_must_stay = hasattr(model.policy, "lstm_hidden_state_shape")
        self._memory: tuple[Floats, ...] | None = None
        self.in_keys = [keys.OBSERVATION]
        if _is_masked(model):
            self.in_keys.append(keys.ACTION_MASK)
        if self.rows_must_stay:
            self.in_keys.append(keys.EGO)

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """What the model predicts, a number [N] or controls [N, 2]."""
        # stable-baselines3 takes NumPy arrays in main memory, whatever device the model is on.
        observation = tensordict.get(keys.OBSERVATION).cpu().numpy()
        shape = self.model.observation_space.shape
        if observation.shape[1:] != shape:
            raise UserError(
                f"{type(self.model).__name__}: it reads observations of shape {list(shape or ())}, "
                f"but the environment gives {list(observation.shape[1:])}; use the observation, "
                "vehicles and lanes of its training."
            )
        if self.normaliser is not None:
            observation = self.normaliser.normalize_obs(observation)

        more: dict[str, Any] = {}
        if _is_masked(self.model):
            more["action_masks"] = mask_in(tensordict).cpu().numpy()
        if self.rows_must_stay:
            # The ego counts its decisions, so an episode that begins is seen without its reset.
            start = tensordict.get(keys.EGO).get("decisions") == 0
            more["episode_start"] = start.cpu().numpy()
            # [layers, N, size]; another environment may have another N.
            if self._memory is not None and self._memory[0].shape[1] == len(observation):
                more["state"] = self._memory

        chosen, self._memory = self.model.predict(observation, deterministic=True, **more)
        # Whole numbers of several types; floats are controls as they are.
        action = torch.as_tensor(chosen, device=tensordict.device)
        if isinstance(self.model.action_space, gymnasium.spaces.Discrete):
            return action.long()
        return action


class ModelDriver(Driver):
    """A stable-baselines3 model as a driver; made by :func:`driver`."""

    policy: ModelPolicy
    observation: ObservationConfig
    actions: ActionParameters

    def save(self, path: str | Path) -> None:
        """Store the model as ``model.save(path)`` does, and beside it what it reads, as JSON.

        ``ppo.zip.json`` has observation, mask, normaliser and the form of the network for ``ganlane
        benchmark ppo.zip``.

        Raises:
            OSError: the files cannot be written.
        """
        file = _model_file(path)
        with atomic_path(file) as part:
            self.policy.model.save(part)

        # Of stable-baselines3's only the numbers that it normalises with are stored.
        normaliser = self.policy.normaliser
        if isinstance(normaliser, VecNormalize):
            statistics: Any = normaliser.obs_rms
            normaliser = Normaliser(
                statistics.mean,
                statistics.var,
                normaliser.epsilon,
                normaliser.clip_obs,
            )
        network = _network(self.policy.model)
        reading = Reading(self.observation, self.mask, normaliser, network, self.actions)
        write_description(file, reading)


def driver(
    model: BaseAlgorithm, name: str | None = None, stored: str | Path | None = None
) -> ModelDriver:
    """A trained model as a driver for ``ganlane.api.evaluate``.

    It drives as in your own loop with ``model.predict(..., deterministic=True)``: on the form and
    scale of the observation that its environment was made with, normalised by its ``VecNormalize``,
    a ``MaskablePPO`` behind its mask (without one behind ``legal``, since it is told then which
    actions stay on the road). Sensor errors, traffic and road are those of the evaluation.

    Args:
        model: PPO, DQN, MaskablePPO, RecurrentPPO, ..., with the environment that it was trained
            on (:func:`make_vec_env`, or ``gymnasium.make("ganlane/Highway-v0")``).
        name: in tables; None: the algorithm's, in lower case.
        stored: the file that :meth:`ModelDriver.save` wrote, for a ``model`` loaded from it without
            an environment.

    Raises:
        UserError: the model has no environment, there is a wrapper that a driver cannot repeat
            (``VecFrameStack``, an ``ObservationWrapper``, ...), or the file beside ``stored`` is
            missing, damaged, or that of another model.
    """
    normaliser: VecNormalize | Normaliser | None
    if stored is None:
        reading, normaliser = _of_environment(model)
    else:
        reading = read_description(_model_file(stored))
        normaliser = reading.normaliser
    policy = ModelPolicy(model, normaliser)
    name = name or type(model).__name__.lower()
    return ModelDriver(name, policy, reading.observation, reading.mask, reading.actions)


def _of_environment(model: BaseAlgorithm) -> tuple[Reading, VecNormalize | None]:
    """What the environment of a model says that it reads and commands, and its normaliser."""
    env = model.get_env()
    if env is None:
        kind = type(model).__name__
        raise UserError(
            f"driver(): this {kind} has no environment, which says what it reads; load it with "
            f"{kind}.load(path, env=make_vec_env(...)), or give stored=path if driver(...).save() "
            "wrote it."
        )

    # From the outermost wrapper to the highway itself.
    normaliser = None
    for layer in _layers(env):
        if isinstance(layer, OnRows):
            settings = layer.settings
            for transform in layer.transforms:
                # A transform of the reward alone is none of the driver's business.
                writes = transform.out_keys
                if not writes or keys.OBSERVATION in writes or transform.in_keys_inv:
                    raise _not_repeatable(transform)
        elif isinstance(layer, VecNormalize) and not layer.norm_obs:
            continue
        elif isinstance(layer, VecNormalize) and normaliser is None:
            normaliser = layer
        elif not isinstance(layer, _TRANSPARENT):
            raise _not_repeatable(layer)

    # Other algorithms drive without a mask, whatever mask their environment shows.
    mask = settings.mask if _is_masked(model) else None
    if mask is not None and mask.form == "none":
        # The environment showed which actions stay on the road. `legal` excludes more: commands
        # during a lane change, all of which have no effect unless a change can be turned back.
        if settings.env.ego.abort_lane_change:
            raise UserError(
                f"driver(): this {type(model).__name__} was trained without a mask on lane changes "
                "that can be turned back; train it with mask='legal' or 'safe'."
            )
        mask = MaskParameters("legal")
    return Reading(settings.observation, mask, actions=settings.env.actions), normaliser


def _network(model: BaseAlgorithm) -> Network | None:
    """The form of a model's network; None: not one that can be rebuilt from its weights."""
    name = type(model).__name__
    activation = getattr(model.policy, "activation_fn", None)
    try:
        return Network(name, getattr(activation, "__name__", ""))
    except ParameterError:
        return None


def _is_masked(model: BaseAlgorithm) -> bool:
    """Whether the algorithm takes masks: sb3-contrib's MaskablePPO and its kin do."""
    return type(model).__name__.startswith("Maskable")


def _layers(env: Any) -> Iterator[Any]:
    """An environment, what it wraps, what that wraps, ..."""
    while env is not None:
        yield env
        if isinstance(env, VecEnvWrapper):
            env = env.venv
        elif isinstance(env, HighwayVecEnv):
            env = env.highways
        elif isinstance(env, DummyVecEnv):
            env = env.envs[0]
        else:
            env = env.env if isinstance(env, gymnasium.Wrapper) else None


def _not_repeatable(layer: Any) -> UserError:
    """The error on a wrapper or transform that changes what the model reads or commands."""
    return UserError(
        f"driver(): {type(layer).__name__} stands between the model and the highway, and a driver "
        "cannot repeat what it does; train without it, or evaluate in your own loop."
    )


def _model_file(path: str | Path) -> Path:
    """The file that stable-baselines3 makes of ``path``: with the ending .zip, if it has none."""
    file = Path(path)
    return file if file.suffix else file.with_suffix(".zip")
