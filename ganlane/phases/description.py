"""What is written down of a phase: to recognise its run, and beside the weights of its agent."""

from __future__ import annotations

from dataclasses import MISSING, asdict, fields, is_dataclass
from typing import Any

from ganlane.config.train import TrainConfig
from ganlane.evaluation import code_version
from ganlane.phases.phase import Phase
from ganlane.training.run import DEFAULTS


def identity(config: TrainConfig, phase: Phase) -> dict[str, Any]:
    """What a resumed run must share with the one that was stopped."""
    parts = {"env": config.env, "reward": config.reward, "collector": config.collector}
    return {
        # Of a run that was begun before there was an option, the default of the option is known.
        DEFAULTS: {
            f"{name}.{key}": value for name, part in parts.items() for key, value in defaults_of(part).items()
        },
        "env": plain(config.env),
        "traffic": phase.traffic.description(),
        "observation": asdict(config.observation),
        "reward": asdict(config.reward),
        # Left out where there is none, as in the runs of versions that knew no masks.
        **({"mask": asdict(config.mask)} if config.mask.form != "none" else {}),
        "init": config.init.path,
        "collector": {name: value for name, value in asdict(config.collector).items() if name != "address"},
        "seed": config.seed,
    }


def plain(config: Any) -> dict[str, Any]:
    """A dataclass by its fields' names, with lists in place of tuples, as JSON has them and older runs do."""
    return {name: _listed(value) for name, value in asdict(config).items()}


def _listed(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _listed(each) for name, each in value.items()}
    return [_listed(each) for each in value] if isinstance(value, list | tuple) else value


def defaults_of(config: Any) -> dict[str, Any]:
    """The defaults of a dataclass's fields by dotted name; nested dataclasses by their own fields."""
    found: dict[str, Any] = {}
    for known in fields(config):
        default = known.default if known.default_factory is MISSING else known.default_factory()
        if is_dataclass(default):
            found |= {f"{known.name}.{name}": value for name, value in defaults_of(default).items()}
        elif default is not MISSING:
            found[known.name] = list(default) if isinstance(default, tuple) else default
    return found


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
        "env": plain(config.env),
        "num_envs": config.collector.environments,
        "code": code_version(),
        "agent": plain(config.agent),
        "reward": asdict(config.reward),
        "training": training,
    }
