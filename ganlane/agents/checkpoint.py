"""Trained agents as files: weights and what is needed to rebuild the network, in safetensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ganlane._version import __version__
from ganlane.agents.network import NetworkConfig, QNetwork, load_parameters
from ganlane.agents.policy import GreedyPolicy
from ganlane.agents.rainbow import Rainbow
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS, load_weights, save_weights

#: Agents that come with the package; others are given by their path.
SHIPPED = ("agent_general", "agent_idm", "agent_gan")


def agent_file(name: str | Path) -> Path:
    """The file of a shipped agent (:data:`SHIPPED`; ``@0`` may follow) or of a path.

    Raises:
        UserError: neither a shipped agent nor a file.
    """
    text = str(name)
    shipped = text.removesuffix("@0")
    path = CHECKPOINTS / f"{shipped}.safetensors" if shipped in SHIPPED else Path(text)
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in CHECKPOINTS.glob("agent_*.safetensors")))
        raise UserError(f"agent {text}: no such file ({path}); the agents that ship are {known}; or give a path.")
    return path


def save_agent(path: str | Path, agent: Rainbow, metadata: Mapping[str, Any]) -> None:
    """Write the agent's online network atomically.

    Args:
        path: ``.safetensors`` file.
        agent: whose weights to write.
        metadata: JSON-serialisable; by convention ``observation`` (the name of the observation) and ``training``
            (traffic, decisions, results). The network's config and the code version are added here.
    """
    header = {**metadata, "network": asdict(agent.network.config), "code_version": __version__}
    save_weights(path, "agent", agent.weights(), header)


def read_agent(name: str | Path) -> tuple[dict[str, Tensor], NetworkConfig, dict[str, Any]]:
    """Weights, network config and metadata of a shipped agent or a checkpoint's path.

    Raises:
        UserError: no such file, or not an agent that ganlane wrote.
    """
    path = agent_file(name)
    weights, metadata = load_weights(path, "agent")
    try:
        stored = dict(metadata["network"])
        config = NetworkConfig(**{**stored, "hidden": tuple(stored["hidden"])})
    except (KeyError, TypeError, UserError) as error:
        raise UserError(
            f"{path}: its description of the network is not understood ({error}); train the agent anew with this "
            "version of ganlane."
        ) from error
    return weights, config, metadata


def load_agent(
    name: str | Path, observation_size: int | None = None, device: torch.device | str = "cpu"
) -> tuple[GreedyPolicy, dict[str, Any]]:
    """A trained agent as a greedy policy, with its metadata.

    Args:
        name: a shipped agent or a checkpoint's path.
        observation_size: D of the environment it is to drive in, checked if given.
        device: where the network goes.

    Raises:
        UserError: no such agent, a foreign file, or another observation size.
    """
    weights, config, metadata = read_agent(name)
    if observation_size is not None:
        check_observation_size(name, config, observation_size)
    try:
        network = QNetwork(config)
        load_parameters(network, weights)
    except UserError as error:
        raise UserError(f"agent {name}: {error}") from error
    return GreedyPolicy(network.to(device)), metadata


def check_observation_size(name: str | Path, config: NetworkConfig, observation_size: int) -> None:
    """Refuse an agent whose network takes another number of inputs."""
    if config.observation_size != observation_size:
        raise UserError(
            f"agent {name}: its network takes observations of shape [{config.observation_size}], but the environment "
            f"gives [{observation_size}]; use the vehicles, lanes and observation it was trained with, or a "
            "fixed-size observation."
        )
