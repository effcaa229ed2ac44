"""Does the agent learn? Rainbow on CartPole-v1, until the mean return of the last 100 episodes reaches 475.

    python benchmarks/cartpole.py --frames 300000 --seeds 5

A benchmark rather than a test: the median over 5 seeds should reach 475 within 300,000 frames.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import tempfile
import time

import torch
from torchrl.envs import EnvBase, GymEnv, SerialEnv

from ganlane.agents import Rainbow, RainbowConfig
from ganlane.training import TrainingConfig, train

#: CartPole ends after 500 steps; with a discount of 0.99 a perfect policy's return is 99.3.
CONFIG = RainbowConfig(
    hidden=(128, 128),
    v_min=0.0,
    v_max=100.0,
    batch_size=128,
    capacity=50_000,
    warmup=1_000,
    decisions_per_update=4,
    target_period=100,
    learning_rate=1e-3,
    adam_eps=1.5e-4,
    beta_updates=50_000,
)
ENVIRONMENTS = 8


class Solved(Exception):
    """The goal is reached."""


class Goal:
    """A log that remembers the best mean return and stops at 475."""

    def __init__(self, goal: float = 475.0) -> None:
        self.goal, self.best, self.decisions = goal, 0.0, 0

    def write(self, row: dict[str, float]) -> None:
        """Look at one row."""
        self.decisions = int(row["decisions"])
        self.best = max(self.best, row.get("mean_return", 0.0))
        if self.best >= self.goal:
            raise Solved

    def close(self) -> None:
        """Nothing to close."""


def make_env(seed: int) -> EnvBase:
    """``ENVIRONMENTS`` cart-poles in one process, actions as numbers."""
    env = SerialEnv(ENVIRONMENTS, lambda: GymEnv("CartPole-v1", categorical_action_encoding=True))
    env.set_seed(seed)
    return env


def run(seed: int, frames: int) -> Goal:
    """Train one seed."""
    goal = Goal()
    agent = Rainbow(CONFIG, observation_size=4, actions=2, seed=seed)
    config = TrainingConfig(frames, log_every=5_000, checkpoint_every_s=1e9)
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(Solved):
        result = train(make_env(seed), agent, config, folder, logs=[goal])
        if result.stopped_by is not None:
            sys.exit(128 + result.stopped_by)
    return goal


def main() -> None:
    """Run all seeds and print the median."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300_000)
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    reached = []
    for seed in range(arguments.seeds):
        begun = time.monotonic()
        goal = run(seed, arguments.frames)
        seconds = time.monotonic() - begun
        print(f"seed {seed}: best mean return {goal.best:.0f} by {goal.decisions:,} frames, {seconds:.0f} s")
        reached.append(goal.decisions if goal.best >= goal.goal else float("inf"))
    print(f"median frames to 475: {statistics.median(reached):,.0f}")


if __name__ == "__main__":
    main()
