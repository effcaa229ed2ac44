"""stable-baselines3's DQN on HighwayEnv: what the same schedule takes with one environment on NumPy."""

from __future__ import annotations

from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch

from ganlane.agents import RainbowConfig
from ganlane.benchmarks.case import EAGER, Case, Labels, Runner
from ganlane.benchmarks.peers import highway_env_settings, highway_env_version, start_highway_env
from ganlane.benchmarks.train_loop import with_gradients
from ganlane.config.env import EnvConfig

MISSING = (
    "stable-baselines3 or HighwayEnv is not installed, so there is no DQN beside ours; "
    '`pip install "ganlane[bench]"` brings both.'
)


def baselines_version() -> str | None:
    """Of the installed stable-baselines3; None where it or HighwayEnv is missing."""
    try:
        return None if highway_env_version() is None else version("stable-baselines3")
    except PackageNotFoundError:
        return None


def start_baselines(settings: dict[str, Any], agent: RainbowConfig, seed: int) -> Runner:
    """DQN on ``highway-v0``; its buffer holds a batch when the clock starts."""
    with torch.random.fork_rng(devices=[]):
        return with_gradients(_Learning(settings, agent, seed))


class _Learning:
    """stable-baselines3's own loop, which can be stopped at any decision; goes on where the last turn ended.

    Its ``learn`` would finish every turn with a whole rollout of ``decisions_per_update``.
    """

    def __init__(self, settings: dict[str, Any], agent: RainbowConfig, seed: int) -> None:
        from stable_baselines3 import DQN

        road: Any = start_highway_env(settings, seed)
        self.frames = road.frames
        self.model: Any = DQN(
            "MlpPolicy",
            road.env,
            buffer_size=agent.capacity,
            batch_size=agent.batch_size,
            train_freq=agent.decisions_per_update,
            gradient_steps=1,
            exploration_initial_eps=0.05,
            policy_kwargs={"net_arch": list(agent.hidden)},
            seed=seed,
            device="cpu",
        )
        _, self.callback = self.model._setup_learn(10**9)
        self.every, self.owed = agent.decisions_per_update, 0
        self._collect(agent.batch_size)

    def __call__(self, decisions: int) -> int:
        missing = decisions
        while missing:
            taken = min(missing, self.every - self.owed)
            self._collect(taken)
            missing, self.owed = missing - taken, self.owed + taken
            if self.owed == self.every:
                self.model.train(gradient_steps=1, batch_size=self.model.batch_size)
                self.owed = 0
        return decisions * self.frames

    def _collect(self, decisions: int) -> None:
        from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

        model, rollout = self.model, TrainFreq(decisions, TrainFrequencyUnit.STEP)
        model.collect_rollouts(model.env, self.callback, rollout, model.replay_buffer, learning_starts=0)


def baselines_case(env: EnvConfig, agent: RainbowConfig, threads: int, seed: int) -> Case:
    """The peer as a case; its network uses torch's threads."""
    labels = Labels(
        suite="train",
        part="speed",
        system=f"stable-baselines3 {baselines_version()} DQN on HighwayEnv {highway_env_version()}",
        traffic="its IDM and MOBIL",
        mode=EAGER,
        dtype="float32",
        device="cpu",
        threads=threads,
        vehicles=env.vehicles,
        lanes=env.lanes,
        batch=1,
    )
    return Case(labels, partial(start_baselines, highway_env_settings(env), agent, seed))
