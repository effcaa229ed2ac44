"""Simulators of others on the same scenario, measured in the same run."""

from __future__ import annotations

import warnings
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from ganlane.benchmarks.case import EAGER, Case, Labels, Runner
from ganlane.config.env import EnvConfig
from ganlane.keys import PHYSICS_STEP_S

#: What to do where the peer is missing.
MISSING = (
    "HighwayEnv is not installed, so there are no ratios to it; "
    '`pip install "ganlane[bench]"` (or `pip install highway-env`) brings it.'
)
_STEPS_PER_S = round(1 / PHYSICS_STEP_S)


def highway_env_version() -> str | None:
    """Of the installed package; None where there is none."""
    try:
        return version("highway-env")
    except PackageNotFoundError:
        return None


def highway_env_settings(env: EnvConfig) -> dict[str, Any]:
    """``config`` of ``highway-v0`` for the same road; what is not named here stays as HighwayEnv has it.

    ``vehicles_count`` counts the others. Episodes end with a crash or after ``duration`` seconds.
    """
    return {
        "lanes_count": env.lanes,
        "vehicles_count": env.vehicles - 1,
        "simulation_frequency": _STEPS_PER_S,
        "policy_frequency": 1 / env.decision_period_s,
        "duration": env.timeout_s,
        "observation": {"type": "Kinematics"},
        "action": {"type": "DiscreteMetaAction"},
    }


def start_highway_env(settings: dict[str, Any], seed: int) -> Runner:
    """``highway-v0`` without rendering and without gymnasium's checks, random actions, a reset after every end."""
    return _RandomDriving(settings, seed)


class _RandomDriving:
    """One environment; goes on where the last turn ended."""

    def __init__(self, settings: dict[str, Any], seed: int) -> None:
        import gymnasium
        import highway_env

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Registering twice is harmless, and importing it is what registers it in some releases.
            getattr(highway_env, "register_highway_envs", lambda: None)()
            made = gymnasium.make("highway-v0", config=settings, disable_env_checker=True)
        self.env: Any = made.unwrapped
        self.env.reset(seed=seed)
        self.random = np.random.default_rng(seed)
        self.frames = int(settings["simulation_frequency"] // settings["policy_frequency"])

    def __call__(self, decisions: int) -> int:
        for action in self.random.integers(self.env.action_space.n, size=decisions):
            _, _, terminated, truncated, _ = self.env.step(int(action))
            if terminated or truncated:
                self.env.reset()
        return decisions * self.frames


def highway_env_case(suite: str, part: str, env: EnvConfig, seed: int) -> Case:
    """HighwayEnv as a case; it is not torch's, so one thread is all it uses."""
    labels = Labels(
        suite=suite,
        part=part,
        system=f"HighwayEnv {highway_env_version()}",
        traffic="its IDM and MOBIL",
        mode=EAGER,
        dtype="float64",
        device="cpu",
        threads=1,
        vehicles=env.vehicles,
        lanes=env.lanes,
        batch=1,
    )
    return Case(labels, partial(start_highway_env, highway_env_settings(env), seed))
