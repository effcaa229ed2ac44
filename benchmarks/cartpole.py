"""Does the agent learn? Rainbow on CartPole-v1, until 100 evaluation episodes have a mean return of
475 or more.

    python -m benchmarks.cartpole
    python -m benchmarks.cartpole --report docs/agent.md

Trained through TorchRL's GymEnv. Every 5,000 frames the greedy policy drives the same 100 episodes.
A benchmark rather than a test: the median over 5 seeds should reach 475 within 300,000 frames.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymEnv, SerialEnv

from benchmarks.script import ReportSection, add_report, make_parser, markdown, run_script
from ganlane.agents import GreedyPolicy, Rainbow, RainbowConfig
from ganlane.evaluation.table import Table
from ganlane.settings.train import TrainConfig
from ganlane.training.loop import train

SECTION = "cartpole"
#: CartPole ends after 500 steps; with a discount of 0.99 a perfect policy's return is 99.3. Noise
#: alone explores.
CONFIG = RainbowConfig(
    hidden=(128, 128),
    gamma=0.99,
    atoms=51,
    v_min=0.0,
    v_max=100.0,
    batch_size=128,
    capacity=50_000,
    warmup=1_000,
    decisions_per_update=4,
    target_period=100,
    learning_rate=5e-4,
    adam_eps=1.5e-4,
    beta_updates=50_000,
    epsilon_start=0.0,
    epsilon=0.0,
)
SEEDS = 5
ENVIRONMENTS, EPISODES, EVERY, GOAL = 8, 100, 5_000, 475.0
#: At most, of each seed.
FRAMES = 300_000


class Solved(Exception):
    """The goal is reached."""


@dataclass
class Outcome:
    """Result of one seed: the best evaluation, the frames at which it reached the goal, and the
    time it took.

    Also a log: it reads the rows of the evaluations and ends the run at the goal.
    """

    seed: int
    best: float = 0.0
    reached: float = math.inf
    seconds: float = 0.0

    def write(self, row: Mapping[str, float]) -> None:
        """Read one row."""
        mean = row.get("evaluation/mean_reward", 0.0)
        self.best = max(self.best, mean)
        if mean >= GOAL:
            self.reached = row["decisions"]
            raise Solved

    def close(self) -> None:
        """Nothing to close."""

    def cells(self) -> list[str]:
        """A row of the table."""
        reached = frames_text(self.reached)
        return [str(self.seed), reached, f"{self.best:.1f}", f"{self.seconds:.0f} s"]


def frames_text(frames: float) -> str:
    """Frames until the goal, infinite where it is not reached."""
    return f"{frames:,.0f}" if frames < math.inf else "not reached"


def make_env(seed: int) -> EnvBase:
    """``ENVIRONMENTS`` cart-poles in one process, actions as numbers."""
    env = SerialEnv(ENVIRONMENTS, lambda: GymEnv("CartPole-v1", categorical_action_encoding=True))
    env.set_seed(seed)
    return env


def evaluate(policy: GreedyPolicy) -> dict[str, float]:
    """Mean return of ``EPISODES`` episodes side by side, the same ones in every call."""
    envs = gymnasium.make_vec("CartPole-v1", EPISODES, vectorization_mode="vector_entry_point")
    observation, _ = envs.reset(seed=1_000_000)
    running, returns = np.ones(EPISODES, dtype=bool), np.zeros(EPISODES)
    while running.any():
        state = TensorDict({"observation": torch.from_numpy(observation)}, [EPISODES])
        actions = policy(state)["action"].numpy()
        observation, reward, terminated, truncated, _ = envs.step(actions)
        returns += reward * running
        running &= ~(terminated | truncated)
    envs.close()
    return {"mean_reward": float(returns.mean())}


def run(seed: int) -> Outcome:
    """Train one seed."""
    outcome, begun = Outcome(seed), time.monotonic()
    agent = Rainbow(CONFIG, observation_size=4, actions=2, seed=seed)
    config = TrainConfig(
        total_decisions=FRAMES,
        log_every=EVERY,
        evaluate_every=EVERY,
        checkpoint_every_s=1e9,
    )
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(Solved):
        result = train(make_env(seed), agent, config, folder, evaluate, logs=[outcome])
        if result.stopped_by is not None:
            sys.exit(128 + result.stopped_by)
    outcome.seconds = time.monotonic() - begun
    return outcome


def measure(options: argparse.Namespace) -> str:
    """Run all seeds; the table, in the document too where one is named.

    A seed that did not reach the goal counts as never.
    """
    section = ReportSection(options.report, SECTION)
    outcomes = []
    for seed in range(SEEDS):
        outcomes.append(run(seed))
        print("seed {}: 475 at {} frames, best {}, {}".format(*outcomes[-1].cells()), flush=True)
    median = statistics.median(outcome.reached for outcome in outcomes)
    lines = [
        *(outcome.cells() for outcome in outcomes),
        ["median", frames_text(median), "", ""],
    ]
    headings = ["seed", "frames to 475", "best mean return", "time"]
    text = markdown(Table("", headings, lines, 4))
    section.write(text)
    return text


if __name__ == "__main__":
    parser = make_parser(__doc__)
    add_report(parser, SECTION)
    sys.exit(run_script(measure, parser.parse_args()))
