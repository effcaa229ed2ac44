"""The highway through gymnasium, small and fast, for tests of its interface."""

from __future__ import annotations

import gymnasium

import ganlane  # noqa: F401 - registers the environments

ID = "ganlane/Highway-v0"
KEEP = 0
LEFT = 1
RIGHT = 2


def make(**options):
    return gymnasium.make(ID, **{"traffic": "idm", "goal_m": 60.0, **options})


def make_vec(rows, **options):
    return gymnasium.make_vec(ID, num_envs=rows, **{"traffic": "idm", "goal_m": 60.0, **options})


def until_the_end(env):
    for _ in range(100):
        step = env.step(KEEP)
        if step[2] or step[3]:
            return step
    raise AssertionError("it never ended")
