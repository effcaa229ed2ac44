"""Trained agents as files (weights and the network's shape, in safetensors), and agents that start from them."""

from __future__ import annotations

import os
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
from ganlane.errors import UserError, as_typed
from ganlane.files import CHECKPOINTS, load_weights, save_weights
from ganlane.parameters.removed import without_removed

#: Agents that come with the package; others are given by their path.
SHIPPED = ("agent_general", "agent_idm", "agent_gan")
#: What says which returns the outputs of a distributional network stand for.
SUPPORT = ("atoms", "v_min", "v_max")


def agent_file(name: str | Path) -> Path:
    """The file of a shipped agent (:data:`SHIPPED`; ``@0`` may follow) or of a path.

    Raises:
        UserError: neither a shipped agent nor a file.
    """
    text = str(name)
    shipped = text.removesuffix("@0")
    path = CHECKPOINTS / f"{shipped}.safetensors" if shipped in SHIPPED else Path(text)
    if not os.path.isfile(path):  # which takes names that are too long for a file
        known = ", ".join(sorted(file.stem for file in CHECKPOINTS.glob("agent_*.safetensors")))
        raise UserError(
            f"agent {text:.100}: no such file ({path!s:.200}); the agents that ship are {known}; or give a path."
        )
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
    """Weights, network config and metadata of a shipped agent or an agent's file.

    Raises:
        UserError: no such file, not an agent that ganlane wrote, or one that needs an option that was removed.
    """
    path = agent_file(name)
    weights, metadata = load_weights(path, "agent")
    for part in ("network", "agent"):
        if isinstance(metadata.get(part), dict):
            metadata[part] = without_removed(metadata[part], str(path))
    try:
        stored = metadata["network"]
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
        name: a shipped agent or an agent's file.
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


def warm_start(
    agent: Rainbow,
    name: str | Path,
    weights: Mapping[str, Tensor],
    network: NetworkConfig,
    moments: Mapping[int, Any] | None = None,
) -> None:
    """Start ``agent`` from the ``weights`` of the trained agent ``name``, and from Adam's ``moments`` if given.

    Raises:
        UserError: the networks differ in what their weights mean, or the moments are those of another network.
    """
    ours = agent.network.config
    check_observation_size(name, network, ours.observation_size)
    ignored = {"noisy_sigma", *(() if ours.distributional else SUPPORT)}
    trained, here = asdict(network), asdict(ours)
    differing = [key for key in here if here[key] != trained[key] and key not in ignored]
    if differing:
        adopt = "give init.support=trained, " if set(differing) <= set(SUPPORT) else ""
        raise UserError(
            f"agent {name}: it has another network than this run (here: {_options(here, differing)}); {adopt}set "
            f"{_options(trained, differing)}, or start with init=none."
        )
    agent.load_weights(weights)
    if moments is not None:
        load_moments(agent, moments)


def _options(network: Mapping[str, Any], names: list[str]) -> str:
    return " ".join(f"agent.{name}={as_typed(network[name])}" for name in names)


def load_moments(agent: Rainbow, moments: Mapping[int, Mapping[str, Tensor]]) -> None:
    """Let Adam go on from the ``moments`` of an agent with the same network; its learning rate stays ``agent``'s.

    Args:
        agent: whose optimiser to change.
        moments: ``step``, ``exp_avg`` and ``exp_avg_sq`` by the place of the parameter in the network; the part
            ``state`` of an optimiser's state.

    Raises:
        UserError: they are those of other parameters.
    """
    shapes = {row: value.shape for row, value in enumerate(agent.network.parameters())}
    try:
        fitting = moments.keys() == shapes.keys() and all(
            moments[row][name].shape == shape and moments[row]["step"].numel() == 1
            for row, shape in shapes.items()
            for name in ("exp_avg", "exp_avg_sq")
        )
    except (AttributeError, KeyError, TypeError):
        fitting = False
    if not fitting:
        raise UserError(
            "init.optimizer=true: the moments in the checkpoint are not those of its network; give another one or "
            "init.optimizer=false."
        )
    # Adam works in place on what it is given.
    own = {row: {name: value.clone() for name, value in moments[row].items()} for row in shapes}
    agent.optimizer.load_state_dict({**agent.optimizer.state_dict(), "state": own})
