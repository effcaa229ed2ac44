"""The state of an agent from which a training run goes on exactly."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ganlane.agents.network import load_parameters, parameters_of
from ganlane.agents.replay import load_replay_state, replay_state
from ganlane.errors import UserError
from ganlane.parameters.agent import RainbowConfig

if TYPE_CHECKING:
    from ganlane.agents.rainbow import Rainbow


def agent_state(agent: Rainbow, with_replay: bool) -> dict[str, Any]:
    """Everything an exact resume needs, as tensors and plain data; noise is redrawn before use, so not here.

    Without the buffer a resume is not exact anyway, so Adam's moments are kept in bfloat16 alone.
    """
    optimizer = agent.optimizer.state_dict()
    return {
        "config": asdict(agent.config),
        "network": agent.weights(),
        "target": parameters_of(agent.loss.target_network),
        "optimizer": optimizer if with_replay else _halved(optimizer),
        "generators": {name: generator.get_state() for name, generator in agent.generators.items()},
        "updates": agent.updates,
        "replay": replay_state(agent.replay) if with_replay else None,
    }


def load_agent_state(agent: Rainbow, state: dict[str, Any]) -> None:
    """Restore :func:`agent_state`; if it was made without the buffer, the buffer is empty afterwards.

    Raises:
        UserError: it is the state of an agent with other hyperparameters or another observation.
    """
    _require_same(agent.config, state["config"])
    load_parameters(agent.network, state["network"])
    load_parameters(agent.loss.target_network, state["target"])
    agent.optimizer.load_state_dict(state["optimizer"])
    for name, generator in agent.generators.items():
        generator.set_state(state["generators"][name].cpu())
    agent.updates = state["updates"]
    agent.replay.empty()
    if state["replay"] is not None:
        load_replay_state(agent.replay, state["replay"])


def _require_same(config: RainbowConfig, saved: dict[str, Any]) -> None:
    """Raise :class:`UserError` where ``config`` is not the ``saved`` agent's."""
    # An agent saved before there was an option has its default.
    saved = {**asdict(RainbowConfig()), **saved}
    for name, value in asdict(config).items():
        if saved[name] != value:
            raise UserError(
                f"agent.{name}={value}: the saved agent has {saved[name]}; give the same to go on from it."
            )


def _halved(optimizer: dict[str, Any]) -> dict[str, Any]:
    """The state of an optimiser with its moments in bfloat16; loading it brings them back to the weights' type."""
    state = {
        row: {name: value.bfloat16() if name.startswith("exp_avg") else value for name, value in moments.items()}
        for row, moments in optimizer["state"].items()
    }
    return {**optimizer, "state": state}
