"""Choosing among the agents of a run, by episodes of a stream on which nothing is trained or reported."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import polars as pl

from ganlane.agents import GreedyPolicy
from ganlane.build import make_env, make_traffic
from ganlane.config.train import TrainConfig
from ganlane.evaluation import run_episodes
from ganlane.phases.phase import Phase
from ganlane.sim.random import Stream


def make_selection(config: TrainConfig, phase: Phase) -> Callable[[GreedyPolicy], Mapping[str, float]]:
    """Drives the greedy policy through episodes of the stream that is kept for choosing among checkpoints."""
    traffic = make_traffic(phase.traffic, config.env, Stream.SELECT)
    rows = min(config.selection_episodes, config.evaluation.num_envs)
    parts = (traffic, config.env, config.observation, config.reward)
    make = partial(make_env, *parts, seed=config.seed, device=config.device, mask=config.mask)
    env, smaller = make(rows), None if config.env.compile else make

    def evaluate(policy: GreedyPolicy) -> dict[str, float]:
        table = run_episodes(env, policy, range(config.selection_episodes), config.seed, make_smaller=smaller)
        return figures(table)

    return evaluate


def figures(table: pl.DataFrame) -> dict[str, float]:
    """What the episodes of ``table``, one per row, come to: reward, its standard error, crashes, lane changes."""
    total = table.select("reward", "lane_changes", "distance_m", crashes=pl.col("reason") == "hard_crash").sum()
    reward, changes, distance_m, crashes = (float(value) for value in total.row(0))
    spread = float(np.std(table["reward"].to_numpy()))
    return {
        "mean_reward": reward / table.height,
        "standard_error": spread / math.sqrt(table.height),
        "crash_rate": crashes / table.height,
        "lane_changes_per_km": 1000.0 * changes / max(distance_m, 1.0),
    }
