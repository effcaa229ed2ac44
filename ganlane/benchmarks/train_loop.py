"""The training loop as something to run: collect, store, learn, with a buffer that is full from the start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.agents import Rainbow, RainbowConfig
from ganlane.agents.drivers import legal_actions
from ganlane.agents.replay import TRANSITION_KEYS
from ganlane.benchmarks.case import Runner
from ganlane.benchmarks.systems import Scenario, build
from ganlane.build import make_road
from ganlane.training.checkpoint import TrainingState
from ganlane.training.loop import collect, learn
from ganlane.transforms import observation_size

#: Priorities set in one go.
_CHUNK = 2**16


@dataclass(frozen=True)
class Training:
    """What is trained where; ``stored`` transitions are in the buffer when the clock starts."""

    scenario: Scenario
    agent: RainbowConfig
    stored: int


def start_training(training: Training, mode: str, device: str, batch: int) -> Runner:
    """Decisions of ``batch`` environments and the updates that they pay for; no logs, no checkpoints."""
    run, _ = filled_run(training, mode, device, batch)
    return with_gradients(partial(advance, run))


def filled_run(training: Training, mode: str, device: str, batch: int) -> tuple[TrainingState, TransformedEnv]:
    """A run that learns from its next decision on, and the environment that it steps."""
    env = build(training.scenario, mode, device, batch)
    run = TrainingState(env, make_agent(training, device))
    fill(run, training.stored)
    return run, env


def make_agent(training: Training, device: str = "cpu") -> Rainbow:
    """An agent with random weights, ready to learn as soon as ``stored`` transitions are there."""
    env, config = training.scenario.env, training.agent
    config = replace(config, warmup=min(config.warmup, training.stored))
    size = observation_size(training.scenario.observation.form, env.vehicles)
    legal = partial(legal_actions, road=make_road(env))
    return Rainbow(config, size, seed=training.scenario.seed, device=device, legal=legal)


def advance(run: TrainingState, decisions: int) -> int:
    """The body of :func:`ganlane.training.train`, so many times; the physics steps simulated, as in a runner."""
    simulated = torch.zeros((), dtype=torch.int64, device=run.agent.device)
    for _ in range(decisions):
        step = collect(run)
        run.agent.store(run.window.push(step))
        learn(run)
        simulated += (step["next", keys.STEP] - step[keys.STEP]).sum()
    return int(simulated)


def with_gradients(run: Runner) -> Runner:
    """``run`` outside of the inference mode in which cases are timed."""

    def learning(decisions: int) -> int:
        with torch.inference_mode(False):
            return run(decisions)

    return learning


def fill(run: TrainingState, stored: int) -> None:
    """Store driven transitions until the agent is warm, and the same again until there are ``stored``.

    A full buffer is what most of a long run has: its memory is in use, and every row of the sampler.
    """
    agent = run.agent
    while not agent.ready:
        agent.store(run.window.push(collect(run)))
    repeat(agent, agent.replay[:].select(*TRANSITION_KEYS), stored)


def repeat(agent: Rainbow, transitions: TensorDict, stored: int) -> None:
    """Store ``transitions`` again and again until there are ``stored``; give all of them priorities."""
    known = transitions.clone()
    while (missing := stored - len(agent.replay)) > 0:
        agent.store(known[:missing])
    if agent.config.prioritised:
        _spread_priorities(agent)


def _spread_priorities(agent: Rainbow) -> None:
    """Different ones, uniform in 0 to 1, as if every transition had been drawn before."""
    for index in torch.arange(len(agent.replay), device=agent.device).split(_CHUNK):
        priority = torch.rand(index.shape, generator=agent.generators["replay"], device=agent.device)
        agent.replay.update_priority(index, priority)
