"""Trained agents as files (weights and the network's shape, in safetensors), and agents that start
from them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ganlane._version import __version__
from ganlane.agents.drivers import GreedyPolicy
from ganlane.agents.network import SHAPE, NetworkConfig, QNetwork, load_parameters
from ganlane.agents.rainbow import Rainbow
from ganlane.errors import UserError, as_typed
from ganlane.files import CHECKPOINTS
from ganlane.settings.agent import RainbowConfig
from ganlane.weights import load_weights, save_weights

#: Agents that come with the package, and their seeds. Of five trainings each is the median by the
#: mean reward on the traffic of its training, of episodes that are kept for choosing
#: (docs/drivers.md). Others are given by their path.
SHIPPED = {"agent_general": 0, "agent_idm": 2, "agent_gan": 2}
#: Kind of a file with several agents.
SEVERAL = "agents"
#: What says which returns the outputs of a distributional network stand for.
SUPPORT = ("atoms", "v_min", "v_max")


def _place(name: str | Path) -> tuple[Path, int | None]:
    """File of an agent, and its seed if the file holds several trainings."""
    # ``RECIPE@SEED``, or ``FILE@SEED``.
    recipe, _, digits = str(name).rpartition("@")
    if digits.isdecimal():
        seed = int(digits)
        # Further trainings of a shipped recipe lie in a file of their own, which a light wheel
        # lacks.
        if recipe in SHIPPED and seed != SHIPPED[recipe]:
            return _seeds_file(recipe), seed
        if recipe in SHIPPED:
            name = recipe
        elif recipe.endswith(".safetensors"):
            return Path(recipe), seed

    if name in SHIPPED:
        return CHECKPOINTS / f"{name}.safetensors", None
    return Path(name), None


def _seeds_file(recipe: str) -> Path:
    """The file of the trainings of a shipped agent's recipe with other seeds."""
    return CHECKPOINTS / f"seeds_of_{recipe}.safetensors"


def names_agent(name: str) -> bool:
    """Whether ``name`` can only be that of a trained agent: one that ships, or a file.

    ``@SEED`` may follow.
    """
    file = str(_place(name)[0])
    # A file's own name may end in @ and digits.
    is_agent = file.endswith(".safetensors") or os.path.isfile(file)
    return is_agent and not name.endswith(".zip")


def with_seeds(name: str) -> list[str]:
    """``agent_idm@all`` as ``agent_idm@0``, ``agent_idm@1`` ..., all trainings there are.

    ``FILE@all`` stands for all agents of a file with several trainings; a mask (``+safe``) may
    follow. Other names stand alone.

    Raises:
        UserError: no such agent or file.
    """
    recipe, every, mask = name.partition("@all")
    if not every:
        return [name]
    if recipe not in SHIPPED:
        # A file of one's own, with several trainings.
        seeds = sorted(_read_several(Path(recipe))[1])
    elif _seeds_file(recipe).is_file():
        # One training is the shipped agent itself; the others are packed together.
        seeds = sorted([SHIPPED[recipe], *_read_several(_seeds_file(recipe))[1]])
    else:
        raise UserError(
            f"{name}: only the training {recipe}@{SHIPPED[recipe]} is installed (a light wheel); "
            "give that, or run pip install -e . in a clone."
        )
    return [f"{recipe}@{seed}{mask}" for seed in seeds]


def _read_several(path: Path) -> tuple[dict[str, Tensor], dict[int, dict[str, Any]]]:
    """Tensors and, by seed, metadata of a file with several trainings."""
    tensors, metadata = load_weights(path, SEVERAL)
    agents = metadata.get("agents")
    # As a file has it: a dictionary for each seed, in digits.
    if not isinstance(agents, dict) or not all(
        seed.isdecimal() and type(agents[seed]) is dict for seed in agents
    ):
        raise UserError(f"{path}: its list of agents is not understood; pack the trainings anew.")
    return tensors, {int(seed): described for seed, described in agents.items()}


def agent_file(name: str | Path) -> Path:
    """The file of a shipped agent (:data:`SHIPPED`; ``@SEED`` may follow) or of a path.

    Raises:
        UserError: there is no such file.
    """
    path, seed = _place(name)
    if not os.path.isfile(path):  # which takes names that are too long for a file
        shipped = sorted(file.stem for file in CHECKPOINTS.glob("agent_*.safetensors"))
        which = "training" if seed is not None and str(name).startswith(tuple(SHIPPED)) else "file"
        raise UserError(
            f"agent {name!s:.100}: no such {which} ({path!s:.200}); the agents that ship are "
            f"{', '.join(shipped)}; or give a path."
        )
    return path


def save_agent(path: str | Path, agent: Rainbow, metadata: Mapping[str, Any]) -> None:
    """Write the agent's online network atomically, as a ``.safetensors`` file.

    Args:
        path: of the file.
        agent: whose network is written.
        metadata: JSON-serialisable; by convention ``observation`` (the name of the observation)
            and ``training`` (traffic, decisions, results). The network's config and the code
            version are added here.
    """
    # Enough to build the network again without the run that trained it.
    network = agent.network.config.description()
    header = {**metadata, "network": network, "code_version": __version__}
    save_weights(path, "agent", agent.weights(), header)


def read_agent(name: str | Path) -> tuple[dict[str, Tensor], NetworkConfig, dict[str, Any]]:
    """Weights, network config and metadata of a shipped agent or an agent's file.

    Raises:
        UserError: no such file, or not an agent that this version of ganlane wrote.
    """
    path = agent_file(name)
    # None: a file with one agent.
    _, seed = _place(name)
    if seed is None:
        weights, metadata = load_weights(path, "agent")
    else:
        tensors, agents = _read_several(path)
        # The file says itself which trainings it holds.
        if seed not in agents:
            seeds = ", ".join(map(str, sorted(agents)))
            raise UserError(
                f"{path}@{seed}: this file has no training with seed {seed}; choose one of {seeds}."
            )
        metadata = agents[seed]
        prefix = f"{seed}/"
        weights = {
            key.removeprefix(prefix): value.float()  # the noise is stored in half precision
            for key, value in tensors.items()
            if key.startswith(prefix)
        }

    # The description comes from a file, so any part of it may be missing or of a wrong type.
    try:
        config = NetworkConfig.described(metadata["network"])
    except (AttributeError, KeyError, TypeError, UserError) as error:
        raise UserError(
            f"{path}: its description of the network is not understood ({error}); train the agent "
            "anew with this version of ganlane."
        ) from error
    return weights, config, metadata


def load_agent(
    name: str | Path, device: torch.device | str = "cpu"
) -> tuple[GreedyPolicy, dict[str, Any]]:
    """A trained agent, shipped or from a file, as a greedy policy on ``device``, with its metadata.

    Raises:
        UserError: no such agent, or a foreign file.
    """
    weights, config, metadata = read_agent(name)
    try:
        # Its parameters are drawn and at once replaced.
        network = QNetwork(config)
        load_parameters(network, weights)
    except UserError as error:
        raise UserError(f"agent {name}: {error}") from error
    return GreedyPolicy(network.to(device)), metadata


def check_observation_size(name: str | Path, config: NetworkConfig, observation_size: int) -> None:
    """Refuse an agent whose network takes another number of inputs."""
    if config.observation_size != observation_size:
        raise UserError(
            f"agent {name}: its network takes observations of shape [{config.observation_size}], "
            f"but the environment gives [{observation_size}]; use the vehicles, lanes and "
            "observation it was trained with, or a fixed-size observation."
        )


def warm_start(
    agent: Rainbow, name: str | Path, weights: Mapping[str, Tensor], network: NetworkConfig
) -> None:
    """Start ``agent`` from the ``weights`` of the trained agent ``name``.

    Raises:
        UserError: the networks differ in what their weights mean.
    """
    # First the mistake that is made most often.
    check_observation_size(name, network, agent.network.config.observation_size)

    # What the weights mean must agree, not how they were learned.
    here = agent.config
    trained = network.agent
    ignored = ("noisy_sigma", *(() if here.distributional else SUPPORT))
    differing = [
        option
        for option in SHAPE
        if option not in ignored and getattr(here, option) != getattr(trained, option)
    ]
    if differing:
        raise UserError(
            f"agent {name}: it has another network than this run (here: "
            f"{as_options(here, differing)}); set {as_options(trained, differing)}, or "
            "start with init=none."
        )

    # Adam starts anew, as at the start of a training.
    agent.load_weights(weights)


def as_options(agent: RainbowConfig, names: Sequence[str]) -> str:
    """Options of ``agent`` as they are typed on the command line."""
    return " ".join(f"agent.{name}={as_typed(getattr(agent, name))}" for name in names)
