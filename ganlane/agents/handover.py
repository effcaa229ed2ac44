"""From a trained agent to one that starts from it: its weights, if the networks are alike, and Adam's moments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import Tensor

from ganlane.agents.checkpoint import check_observation_size, read_agent
from ganlane.agents.network import NetworkConfig
from ganlane.agents.rainbow import Rainbow
from ganlane.errors import UserError, as_typed

#: What says which returns the outputs of a distributional network stand for.
SUPPORT = ("atoms", "v_min", "v_max")


def transfer(agent: Rainbow, name: str | Path) -> dict[str, Any]:
    """Start ``agent`` from a trained one; return the trained one's metadata.

    Raises:
        UserError: as :func:`load_agent`, or the networks or their supports differ.
    """
    weights, config, metadata = read_agent(name)
    check_network(name, config, agent.network.config)
    agent.load_weights(weights)
    return metadata


def check_network(name: str | Path, theirs: NetworkConfig, ours: NetworkConfig) -> None:
    """Refuse to start a network from that of agent ``name``, unless the two are alike in what the weights mean.

    Raises:
        UserError: names the options of the command line that differ.
    """
    check_observation_size(name, theirs, ours.observation_size)
    aside = {"noisy_sigma"}
    aside |= {"encoder_width", "encoder_layers"} if ours.encoder == "none" else set()
    aside |= set() if ours.distributional else set(SUPPORT)
    trained, here = asdict(theirs), asdict(ours)
    differing = [key for key in here if here[key] != trained[key] and key not in aside]
    if differing:
        adopt = "give init.support=trained, " if set(differing) <= set(SUPPORT) else ""
        raise UserError(
            f"agent {name}: it has another network than this run (here: {_options(here, differing)}); {adopt}set "
            f"{_options(trained, differing)}, or start with init=none."
        )


def _options(network: Mapping[str, Any], names: list[str]) -> str:
    return " ".join(f"agent.{name}={as_typed(network[name])}" for name in names)


def load_moments(agent: Rainbow, moments: Mapping[int, Mapping[str, Tensor]]) -> None:
    """Let Adam go on from the ``moments`` of an agent with the same network.

    Its learning rate, epsilon and betas stay those of ``agent``.

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
