"""What is written down of a phase: to recognise its run, and beside the weights of its agent."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from ganlane.config.train import TrainConfig
from ganlane.evaluation import code_version
from ganlane.phases.phase import Phase


def identity(config: TrainConfig, phase: Phase) -> dict[str, Any]:
    """What a resumed run must share with the one that was stopped."""
    return {
        "env": asdict(config.env),
        "traffic": phase.traffic.description(),
        "observation": asdict(config.observation),
        "reward": asdict(config.reward),
        # Left out where there is none, as in the runs of versions that knew no masks.
        **({"mask": asdict(config.mask)} if config.mask.form != "none" else {}),
        "init": config.init.path,
        "collector": {name: value for name, value in asdict(config.collector).items() if name != "address"},
        "seed": config.seed,
    }


def describe(config: TrainConfig, phase: Phase) -> dict[str, Any]:
    """Metadata of the agent's files."""
    scale = {"range_m": config.observation.range_m, "speed_mps": config.observation.speed_mps}
    training = {"phase": phase.name, "init": phase.init, "seed": config.seed, "traffic": phase.traffic.description()}
    environment = {"vehicles": config.env.vehicles, "lanes": config.env.lanes}
    return {
        "observation": config.observation.form,
        "observation_scale": scale,
        "mask": asdict(config.mask),
        "sensors": asdict(config.observation)["sensors"],
        "environment": environment,
        "env": asdict(config.env),
        "num_envs": config.collector.environments,
        "code": code_version(),
        "agent": asdict(config.agent),
        "reward": asdict(config.reward),
        "training": training,
    }
