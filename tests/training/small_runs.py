"""Trainings of seconds: a highway that is learned in a few hundred decisions, and a small agent."""

import csv
import os
from contextlib import contextmanager

import pytest
from agents import agents_small

from ganlane.build import make_env, make_traffic
from ganlane.settings.commands import DrivingConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmTrafficConfig
from ganlane.settings.train import LoggerConfig, TrainConfig
from ganlane.training import loop

#: With one lane: any command to change leaves the road, and who keeps the lane reaches the goal.
ROAD = EnvConfig(lanes=1, vehicles=2, goal_m=60.0)
OBSERVATION_SIZE = 29
SMALL = {
    "hidden": (32, 32),
    "batch_size": 64,
    "capacity": 300,
    "warmup": 64,
    "decisions_per_update": 8,
    "atoms": 21,
    "target_period": 20,
    "learning_rate": 3e-3,
    "gamma": 0.8,
    "epsilon_start": 0.0,
    "epsilon": 0.0,
}


def road(rows=8):
    return make_env(make_traffic(IdmTrafficConfig(), ROAD), DrivingConfig(env=ROAD), rows)


def agent(seed=0, **options):
    return agents_small.agent(OBSERVATION_SIZE, seed, **{**SMALL, **options})


def settings(decisions, progress=False, **options):
    logger = LoggerConfig(progress=progress)
    options = {"log_every": 400, **options}
    return TrainConfig(total_decisions=decisions, logger=logger, **options)


def train(*arguments, **options):
    """A run to its end.

    One that a signal stops, say the SIGTERM of `timeout`, would fail here as other weights.
    """
    result = loop.train(*arguments, **options)
    if result.stopped_by is not None:
        number = result.stopped_by
        pytest.exit(f"a run was stopped by signal {number}", returncode=128 + number)
    return result


@contextmanager
def signal_at(decisions, number):
    """A run in this block gets the signal after so many decisions."""
    advance = loop.advance

    def interrupted(state):
        step = advance(state)
        if state.decisions == decisions:
            os.kill(os.getpid(), number)
        return step

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "advance", interrupted)
        yield


def rows(path):
    """The rows of a CSV of figures."""
    with path.open() as file:
        return [
            {name: float(figure or "nan") for name, figure in row.items()}
            for row in csv.DictReader(file)
        ]
