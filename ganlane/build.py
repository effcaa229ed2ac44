"""Environments, traffic and drivers from config dataclasses, without Hydra.

::

    config = DrivingConfig(env=EnvConfig(lanes=4))
    road = make_env(make_traffic(GanTrafficConfig(), config.env), config, num_envs=256)
    driver = make_driver("mobil", config.env)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, Transform

from ganlane import keys
from ganlane.agents import load_agent
from ganlane.agents.checkpoint import SHIPPED, check_observation_size, names_agent, with_seeds
from ganlane.agents.drivers import DRIVERS, FunctionPolicy, MaskedPolicy
from ganlane.agents.stored_models import SHIPPED_MODELS, Reading, load_model
from ganlane.arguments import call_with, import_target, imported, is_function_path, is_import_path
from ganlane.env import HighwayEnv, TransformedHighway
from ganlane.errors import ParameterError, UserError
from ganlane.files import CHECKPOINTS
from ganlane.settings.actions import ActionParameters
from ganlane.settings.commands import DrivingConfig, HighwayConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import MASKS, MaskParameters, ObservationConfig
from ganlane.settings.record import below, make
from ganlane.settings.traffic import TrafficConfig
from ganlane.sim.dynamics import STEERING
from ganlane.sim.random import Stream
from ganlane.traffic import BlindTraffic, TrafficModule
from ganlane.transforms import (
    ActionMaskTransform,
    ObservationTransform,
    RewardTransform,
    SensorTransform,
    observation_size,
)

Driving = TypeVar("Driving", bound=DrivingConfig)


def make_highways(config: HighwayConfig) -> TransformedHighway:
    """The environments of a call: traffic, road, observation, reward and mask.

    Raises:
        UserError: see :func:`make_traffic` and :class:`ganlane.env.HighwayEnv`.
    """
    # The random numbers of the traffic come from the same stream as those of the episodes.
    traffic = make_traffic(config.traffic, config.env, Stream.named(config.stream))
    return make_env(traffic, config, config.num_envs)


def _constructor_arguments(env: EnvConfig, stream: int) -> dict[str, Any]:
    """What the constructors of traffic models and drivers are given where they have an argument of
    that name.

    :func:`call_with` leaves out what they have no argument for.
    """
    return {
        "road": env.road(),
        "stream": stream,
        "idm": env.idm,
        "mobil": env.mobil,
        "steering": STEERING,
        "spawn": env.spawn_parameters(),
    }


def make_traffic(
    traffic: TrafficConfig, env: EnvConfig, stream: int = Stream.TRAIN
) -> TrafficModule:
    """The traffic model that ``traffic`` names, on the road of ``env``.

    Args:
        traffic: its class and parameters.
        env: the environment, which has the road, and the models that drive by default.
        stream: stream of its random numbers.

    Raises:
        UserError: the target cannot be imported or called, or gives no
            :class:`ganlane.traffic.TrafficModule`.
    """
    # Importing runs code: the path is this package's or was named by the user.
    key = "traffic._target_"
    target = import_target(traffic._target_, key, TrafficModule)
    arguments = traffic.arguments()
    # A mixed traffic has parts, each with a traffic model of its own, built the same way.
    parts = traffic.parts()
    if parts:
        arguments["parts"] = {name: make_traffic(part, env, stream) for name, part in parts.items()}
    module = call_with(target, _constructor_arguments(env, stream), arguments, key)
    if not isinstance(module, TrafficModule):  # an annotation may be wrong
        raise UserError(
            f"{key}={traffic._target_}: returned a {type(module).__name__}, expected a "
            "TrafficModule."
        )
    # Drivers that overlook the ego are a wrapper, so that they work with every traffic model.
    if traffic.blind_share:
        return BlindTraffic(module, traffic.blind_share)
    return module


def make_env(
    traffic: TrafficModule, config: DrivingConfig, num_envs: int = 1
) -> TransformedHighway:
    """A batched environment with observation, reward and optionally action mask; its stream is that
    of the traffic.

    Raises:
        UserError: see :class:`ganlane.env.HighwayEnv`.
    """
    env = config.env
    base = HighwayEnv(
        traffic,
        num_envs,
        env.vehicles,
        env.spawn_parameters(),
        env.ego,
        env.episode_parameters(),
        env.idm,
        seed=config.seed,
        device=config.device,
        # By kind of traffic, others notice earlier or later who enters their lane.
        scenes=env.scenes(traffic.visibility),
        recycle=env.recycle,
        recycle_share=env.recycle_share,
        kernel=env.kernel,
        actions=env.actions,
        mobil=env.mobil,
    )

    # In the order in which a state passes through them.
    transforms: list[Transform] = []
    observation = config.observation
    # False where the native kernel does not implement what is asked for.
    native = base.kernel is not None
    transforms.append(
        ObservationTransform(
            base.road,
            env.vehicles,
            observation.form,
            observation.scale(),
            native,
            env.actions,
        )
    )
    mask = config.mask
    if mask.form != "none":
        transforms.append(
            ActionMaskTransform(
                base.road,
                mask.form,
                mask.safe_deceleration,
                env.idm,
                # It needs to know whether a lane change under way may be called off.
                env.ego.abort_lane_change,
                env.vehicles if native else None,
                env.actions,
            )
        )
    if observation.sensors is not None:
        with below("observation.sensors"):
            sensors = SensorTransform(observation.sensors, traffic.stream, env.decision_period_s)
        # What the ego's sensors get wrong comes before the observation that is made of it.
        transforms.insert(0, sensors)
    transforms.append(RewardTransform(env.decision_period_s, config.reward))
    return TransformedHighway(base, Compose(*transforms))


@dataclass(frozen=True)
class Driver:
    """A policy for the ego.

    Attributes:
        name: in tables.
        policy: writes ``action``.
        observation: what it reads; None: any.
        mask: of its actions; None: that of the command or call, by default none.
        actions: what it commands; None: what the environment of the command or call takes.
    """

    name: str
    policy: TensorDictModuleBase = field(repr=False)
    observation: ObservationConfig | None = None
    mask: MaskParameters | None = None
    actions: ActionParameters | None = None

    def renamed(self, name: str) -> Driver:
        """The same driver under another name."""
        return replace(self, name=name)

    def driving(self, config: Driving) -> tuple[Driving, TensorDictModuleBase]:
        """``config`` for this driver, and the policy behind the mask in force.

        The driver's own observation, mask and actions, if it has any, go before those of
        ``config``.
        """
        mask = self.mask or config.mask
        actions = self.actions or config.env.actions
        driven = replace(
            config,
            env=replace(config.env, actions=actions),
            observation=config.observation.read_by(self.observation),
            mask=mask,
        )
        if mask.form == "none":
            return driven, self.policy
        return driven, MaskedPolicy(self.policy)


def make_driver(
    name: str, env: EnvConfig, stream: int = Stream.REPORT, device: str = "cpu"
) -> Driver:
    """A driver by its name.

    Args:
        name: a rule-based one (:data:`ganlane.agents.drivers.DRIVERS`), a shipped agent
            (``agent_idm@1``: the recipe of ``agent_idm``, trained with seed 1), the path of an
            agent's file (.safetensors; .zip of ``ganlane.sb3.driver(model).save``), or the import
            path of a policy of your own (a class or annotated function; it may have
            ``road``, ``stream``, ``idm`` and ``mobil``; with a colon,
            ``module:function``, a function of observations,
            :class:`ganlane.agents.drivers.FunctionPolicy`). A suffix ``+safe``, ``+legal``
            or ``+none`` sets its mask in place of the one in its training.
        env: the environment in which it drives.
        stream: stream of its random numbers, if it draws any.
        device: device of its network.

    Raises:
        UserError: no such driver, or a network of another shape than the environment's observation.
    """
    # A name such as agent_idm+safe: the agent, behind another mask than its own.
    unmasked, plus, form = name.rpartition("+")
    if plus and form in MASKS:
        driver = make_driver(unmasked, env, stream, device)
        mask = driver.mask
        # the agent's own bounds stay where its form is asked for
        if mask is None or mask.form != form:
            mask = MaskParameters(form)
        return replace(driver, name=name, mask=mask)

    # a rule-based one, which commands lanes
    if name in DRIVERS:
        policy = call_with(DRIVERS[name], _constructor_arguments(env, stream), {}, "agents")
        return Driver(name, policy.to(device), actions=ActionParameters())

    # a trained agent, shipped or a file
    if names_agent(name):
        # Only the metadata tell which observation the agent needs.
        network, metadata = load_agent(name, device=device)
        reading = reading_of(metadata)
        size = observation_size(reading.observation.form, env.vehicles, reading.actions)
        check_observation_size(name, network.network.config, size)
        return Driver(name, network, reading.observation, reading.mask, reading.actions)

    # a model of stable-baselines3, by its weights
    stored = CHECKPOINTS / f"{name}.zip" if name in SHIPPED_MODELS else Path(name)
    if stored.suffix == ".zip":
        model, reading = load_model(stored, device)
        return Driver(name, model, reading.observation, reading.mask, reading.actions)

    # a plain function of observations
    if is_function_path(name):
        return Driver(name, FunctionPolicy(imported(name, "agents")))

    # a user's own policy; it reads the raw state or the observation of the command
    if is_import_path(name):
        target = import_target(name, "agents", TensorDictModuleBase)
        policy = call_with(target, _constructor_arguments(env, stream), {}, "agents")
        out_keys = getattr(policy, "out_keys", [])
        if not isinstance(policy, TensorDictModuleBase) or keys.ACTION not in out_keys:
            raise UserError(
                f"agents={name}: expected a TensorDictModule that writes 'action'; its out_keys "
                "name it."
            )
        return Driver(name, policy.to(device))

    # A light wheel lacks some of the files, so only those that are there are suggested.
    shipped = [name for name in SHIPPED if (CHECKPOINTS / f"{name}.safetensors").is_file()]
    names = ", ".join([*DRIVERS, *shipped, *SHIPPED_MODELS])
    raise UserError(
        f"agent {name:.100}: unknown; choose one of {names}, or give a checkpoint's path "
        "(.safetensors) or the import path of a policy."
    )


def make_drivers(
    names: Sequence[str], env: EnvConfig, device: str = "cpu", stream: int = Stream.REPORT
) -> list[Driver]:
    """:func:`make_driver` for several names.

    ``agent_idm@all`` means every shipped training of its recipe.
    """
    # A dictionary drops repeated names and keeps their order.
    single_names: dict[str, None] = {}
    for name in names:
        single_names |= dict.fromkeys(with_seeds(name))
    return [make_driver(name, env, stream, device) for name in single_names]


def reading_of(metadata: Mapping[str, Any]) -> Reading:
    """What an agent reads and commands, from the metadata of its file.

    Those of 0.3.0 name no actions: there were no others than the lane.

    Raises:
        UserError: no observation, mask or actions, or unknown ones.
    """
    try:
        scale = metadata["observation_scale"]
        observation = ObservationConfig(form=metadata["observation"], **scale)
        mask = MaskParameters(**metadata["mask"])
        env = metadata.get("env") or {}
        actions = make(ActionParameters, env.get("actions") or {})
    except (KeyError, TypeError, AttributeError, ParameterError) as error:
        raise UserError(
            "the agent's metadata name no observation, mask and actions that are known here "
            f"({error}); train it again or give another."
        ) from error
    # With the mask "none" it takes that of the command.
    own_mask = None if mask.form == "none" else mask
    return Reading(observation, own_mask, actions=actions)
