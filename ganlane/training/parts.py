"""Check the parts of a checkpoint against the run, before they are used.

A damaged part would do harm later: Adam writes beyond moments that are too short, and a replay buffer that samples
rows it does not hold returns arbitrary memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import torch
from torch import Tensor

from ganlane import keys
from ganlane.agents import NetworkConfig, Rainbow
from ganlane.agents.n_step import Step
from ganlane.agents.replay import MASK_KEY, ROW
from ganlane.training.stats import EpisodeStats

#: Upper bound of the decisions, updates and rows of a run.
MOST = 2**53
#: Name of the action masks in the rows of the replay buffer, if there are masks.
MASK = ".".join(MASK_KEY)


def check_parts(
    state: Mapping[str, Any], agent: Rainbow, environments: Mapping[str, Any], stats: EpisodeStats
) -> None:
    """Compare ``state`` (:meth:`~ganlane.training.checkpoint.TrainingState.state_dict`) with that of a new run.

    Args:
        state: of the checkpoint.
        agent: with Adam's moments already loaded from the checkpoint.
        environments: state of the environments of a new run.
        stats: of a new run.

    Raises:
        ValueError: a part has another structure, shape or type, or impossible numbers.
        TypeError, KeyError, AttributeError: a part has another type altogether.
    """
    network, counters, replay = agent.network, state["counters"], state["agent"]["replay"]
    moments = agent.optimizer.state_dict()["state"]
    adam = {
        row: {"step": torch.zeros(()), "exp_avg": value, "exp_avg_sq": value}
        for row, value in enumerate(network.parameters())
    }
    check_like(moments, adam if moments else {}, "optimizer")
    check_like(state["agent"]["updates"], 0, "updates")
    best = None if counters["best"] is None else 0.0
    check_like(counters, {"decisions": 0, "pending_decisions": 0, "wall_s": 0.0, "best": best}, "counters")
    if replay is not None:
        _check_replay(replay, agent)
    if state["window"] is not None:  # the resumed run will be exact
        check_like(state["env_state"], environments, "env_state")
        mask = environments["items"].get(keys.ACTION_MASK)
        if replay["rows"] and (MASK in replay["rows"]) != (mask is not None):
            raise ValueError("replay: its masks are those of another run")
        _check_window(state["window"]["steps"], agent, len(stats.returns), mask)
        _check_stats(state["stats"], stats)


def _check_replay(replay: Mapping[str, Any], agent: Rainbow) -> None:
    rows, cursor, capacity = replay["rows"], replay["cursor"], agent.config.capacity
    count = len(rows["action"]) if rows else 0
    check_like(replay, {"cursor": 0, "writes": 0}, "replay")
    if rows:
        like = transitions(count, agent.network.config)
        check_like(rows, {name: like[name] for name in like if name != MASK or MASK in rows}, "replay")
        _check_actions(rows["action"], agent.network.config)
        steps = rows["steps_to_next_obs"]
        if ((steps < 1) | (steps > agent.config.n_step)).any():
            raise ValueError("replay: transitions of more steps than the run's")
    if not (cursor == count < capacity or cursor < count == capacity):
        raise ValueError(f"replay: {count} rows of {capacity}, the next one is {cursor}")
    if agent.config.prioritised:
        own = torch.arange(-(-count // ROW) * ROW, device=agent.device).view(-1, ROW) < count
        expected: dict[str, Any] = {"priorities": own.float(), "largest": torch.zeros(()), "beta": 0.0}
        check_like(replay["sampler"], expected, "replay.sampler")
        if not torch.equal(replay["sampler"]["priorities"] > 0, own):
            raise ValueError("replay: priorities of rows that do not exist")


def _check_window(steps: list[dict[str, Any]], agent: Rainbow, environments: int, mask: Tensor | None) -> None:
    rows = transitions(environments, agent.network.config)
    observation, end = rows["observation"], rows["next.terminated"]
    step = Step(observation, rows["action"], rows["next.reward"], observation, end, end, mask)._asdict()
    check_like(steps, [step] * min(len(steps), agent.config.n_step - 1), "window")
    for step in steps:
        _check_actions(step["action"], agent.network.config)


def _check_stats(saved: Mapping[str, Any], fresh: EpisodeStats) -> None:
    one, shares = torch.zeros((), dtype=torch.float64), torch.zeros(len(fresh.actions), dtype=torch.float64)
    sums = {name: shares if name == "actions" else one for name in saved["sums"]}
    updates = dict.fromkeys(saved["updates"], torch.zeros(()))
    check_like(saved, {**fresh.state_dict(), "sums": sums, "updates": updates}, "stats")
    if updates and saved["update_count"] == 0:
        raise ValueError("stats: sums over no update")


def _check_actions(taken: Tensor, network: NetworkConfig) -> None:
    if ((taken < 0) | (taken >= network.actions)).any():
        raise ValueError("actions out of range")


def transitions(rows: int, network: NetworkConfig) -> dict[str, Tensor]:
    """Shapes and types of the rows of the replay buffer as meta tensors, by dotted key."""
    number = torch.empty(rows, 1, device="meta")
    observation = number.expand(rows, network.observation_size)
    after = {"next.observation": observation, "next.reward": number, "next.terminated": number.bool()}
    after[MASK] = number.expand(rows, network.actions).bool()
    return {"observation": observation, "action": number[:, 0].long(), "steps_to_next_obs": number, **after}


def check_like(found: Any, like: Any, name: str) -> None:
    """Raise :class:`ValueError` unless ``found`` has at least the keys of ``like``, its lengths, shapes and types.

    Numbers outside tensors must be finite, counts at least 0.
    """
    if isinstance(like, Tensor):
        fits = isinstance(found, Tensor) and (found.shape, found.dtype) == (like.shape, like.dtype)
    elif isinstance(like, dict):
        fits = isinstance(found, dict) and found.keys() >= like.keys()
    elif isinstance(like, list):
        fits = isinstance(found, list) and len(found) == len(like)
    elif isinstance(like, int):
        fits = type(found) is int and 0 <= found < MOST
    elif isinstance(like, float):
        fits = type(found) in (int, float) and isfinite(found)
    else:
        fits = found is like
    if not fits:
        raise ValueError(f"{name} cannot be of this run")
    if isinstance(like, dict | list):
        for key in like if isinstance(like, dict) else range(len(like)):
            check_like(found[key], like[key], f"{name}.{key}")
