"""Every driver on every traffic, on the same episodes."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from ganlane.build import make_drivers
from ganlane.compare import compare, publish
from ganlane.config.evaluate import EvaluateConfig
from ganlane.torch_settings import set_threads


def evaluate(config: EvaluateConfig, folder: Path) -> str:
    """Run the episodes, print and save the table; the line that names the results."""
    set_threads(config.threads)
    drivers = make_drivers(config.agents, config.env, config.device)
    table = compare(drivers, config)
    seeds = {"stream": config.stream, "seed": config.seed, "episodes": [0, config.episodes - 1]}
    return publish(table, folder, asdict(config), seeds)
