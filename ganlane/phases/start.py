"""What a phase starts from: a trained agent's weights, network and observation, and Adam's moments where kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from ganlane.agents import NetworkConfig, Rainbow, RainbowConfig, read_agent
from ganlane.agents.checkpoint import SHIPPED
from ganlane.agents.handover import SUPPORT, check_network, load_moments
from ganlane.build import observation_of
from ganlane.config.train import TrainConfig
from ganlane.errors import UserError
from ganlane.parameters.observation import ObservationConfig
from ganlane.training.checkpoints import LAST, load_checkpoint
from ganlane.transforms import observation_size


@dataclass(frozen=True)
class Start:
    """A trained agent; ``moments`` are Adam's by parameter, None where the file holds weights alone."""

    name: str
    weights: Mapping[str, Tensor]
    network: NetworkConfig
    observation: ObservationConfig
    moments: Mapping[int, Any] | None = None


def read_start(name: str, key: str = "init.path") -> Start:
    """The agent that ``init.path`` means.

    Args:
        name: a shipped agent or a ``.safetensors`` file; or a training run's folder or its ``last.pt``, for the agent
            as the run last saved it, with its moments.
        key: of the command line that gave ``name``.

    Raises:
        UserError: nothing of the sort is there, or it cannot be read.
    """
    path = Path(name)
    if path.suffix == ".pt" or (path.is_dir() and name not in SHIPPED):
        return _of_checkpoint(path / LAST if path.is_dir() else path, key)
    weights, network, metadata = read_agent(name)
    return Start(name, weights, network, observation_of(metadata))


def _of_checkpoint(path: Path, key: str) -> Start:
    """The agent in a training run's resume checkpoint."""
    if not path.is_file():
        raise UserError(f"{key}={path}: no such file; give a training run's folder, its {LAST}, or an agent's file.")
    try:
        state = load_checkpoint(path)
        agent, identity = state["agent"], state["identity"]
        scale = {name: identity["observation"][name] for name in ("range_m", "speed_mps")}
        observation = ObservationConfig(form=identity["observation"]["form"], **scale)
        size = observation_size(observation.form, identity["env"]["vehicles"])
        network = NetworkConfig.of(RainbowConfig(**agent["config"]), size)
        weights = {name: value.detach() for name, value in agent["network"].items()}
        return Start(str(path), weights, network, observation, agent["optimizer"]["state"])
    except (AttributeError, KeyError, TypeError, ValueError, UserError) as error:
        raise UserError(
            f"{key}={path}: not a training checkpoint that this version of ganlane can read; give a run's folder, "
            f"its {LAST}, or an agent's .safetensors file."
        ) from error


def with_support(config: TrainConfig, start: Start) -> TrainConfig:
    """``config`` with the atoms, v_min and v_max of ``start``, if ``init.support=trained``."""
    if config.init.support != "trained":
        return config
    support = {name: getattr(start.network, name) for name in SUPPORT}
    return replace(config, agent=replace(config.agent, **support))


def give(agent: Rainbow, start: Start, moments: bool) -> None:
    """Let ``agent`` start from the weights of ``start``, and from Adam's ``moments`` where they are asked for.

    Raises:
        UserError: the networks differ, or there are no moments.
    """
    check_network(start.name, start.network, agent.network.config)
    if moments and not start.moments:
        raise UserError(
            f"init.optimizer=true: {start.name} holds no moments of the optimiser; give init.path a training run's "
            f"folder or its {LAST}, saved after its first update, or init.optimizer=false."
        )
    agent.load_weights(start.weights)
    if moments and start.moments:
        load_moments(agent, start.moments)
