"""TorchRL's distributional loss beside the lean one, on the same network, batch and optimiser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import DistributionalDQNLoss

from ganlane.agents import Rainbow
from ganlane.benchmarks.case import EAGER, Case, Labels, Runner
from ganlane.benchmarks.timing import Budget, take_turns, torch_threads
from ganlane.benchmarks.train_loop import Training, make_agent, repeat, with_gradients

THEIRS, OURS = "TorchRL's DistributionalDQNLoss", "lean loss"
WHOLE = "whole update, with the lean loss"


def compare_losses(training: Training, threads: Sequence[int], budget: Budget) -> list[dict[str, Any]]:
    """``system, threads, batch_size``, ``milliseconds`` and ``cpu_milliseconds`` of an update, per number of threads.

    The first two are loss, backward pass and optimiser step; the third is all that an update of the agent does.
    """
    starts: dict[str, Callable[[Training], Runner]] = {
        THEIRS: partial(start_loss, theirs=True),
        OURS: partial(start_loss, theirs=False),
        WHOLE: start_update,
    }
    return [row for number in threads for row in _compared(training, number, budget, starts)]


def _compared(
    training: Training, threads: int, budget: Budget, starts: dict[str, Callable[[Training], Runner]]
) -> list[dict[str, Any]]:
    """All of ``starts`` in turns."""
    env = training.scenario.env
    cases = [
        Case(
            Labels("train", "loss", system, "-", EAGER, "float32", "cpu", threads, env.vehicles, env.lanes, 1),
            partial(start, training),
        )
        for system, start in starts.items()
    ]
    with torch_threads(threads):
        samples = take_turns(cases, [case.start() for case in cases], budget)
    return [
        {
            "system": case.labels.system,
            "threads": threads,
            "batch_size": training.agent.batch_size,
            "milliseconds": 1000 * median(sample.wall_s / sample.decisions for sample in taken),
            "cpu_milliseconds": 1000 * median(sample.cpu_s / sample.decisions for sample in taken),
        }
        for case, taken in zip(cases, samples)
    ]


def start_loss(training: Training, theirs: bool) -> Runner:
    """Updates on one and the same batch, without weights of importance."""
    agent = make_agent(training)
    batch = random_transitions(agent, training.agent.batch_size)
    forward = partial(DistributionalDQNLoss.forward, agent.loss) if theirs else agent.loss

    def run(updates: int) -> int:
        for _ in range(updates):
            _descend(agent, forward, batch)
        return 0

    return with_gradients(run)


def _descend(agent: Rainbow, forward: Callable[[TensorDictBase], TensorDictBase], batch: TensorDict) -> None:
    agent.optimizer.zero_grad(set_to_none=True)
    forward(batch.clone(recurse=False))["loss"].mean().backward()
    agent.optimizer.step()


def start_update(training: Training) -> Runner:
    """:meth:`ganlane.agents.Rainbow.update` with ``training.stored`` transitions in the buffer."""
    agent = make_agent(training)
    repeat(agent, random_transitions(agent, min(training.stored, 10_000)), training.stored)

    def run(updates: int) -> int:
        for _ in range(updates):
            agent.update()
        return 0

    return with_gradients(run)


def random_transitions(agent: Rainbow, rows: int) -> TensorDict:
    """Transitions as :meth:`ganlane.agents.NStepWindow.push` gives them, of numbers of their size."""
    generator = torch.Generator().manual_seed(0)
    config = agent.network.config
    observation, following = torch.randn(2, rows, config.observation_size, generator=generator)
    reward = torch.randn(rows, 1, generator=generator)
    terminated = torch.rand(rows, 1, generator=generator) < 0.01
    after = TensorDict({"observation": following, "reward": reward, "terminated": terminated}, [rows])
    content = {
        "observation": observation,
        "action": torch.randint(config.actions, (rows,), generator=generator),
        "steps_to_next_obs": torch.full((rows, 1), float(agent.config.n_step)),
        "next": after,
    }
    return TensorDict(content, [rows])
