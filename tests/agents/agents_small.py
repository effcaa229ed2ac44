"""A small agent, and its file."""

from pathlib import Path

from ganlane.agents import Rainbow, RainbowConfig, save_agent

SMALL = {"hidden": (8, 8), "batch_size": 8, "warmup": 8, "capacity": 100}


def agent(size=5, seed=0, **options):
    return Rainbow(RainbowConfig(**{**SMALL, **options}), size, seed=seed)


def saved_in(folder: Path) -> Path:
    path = folder / "agent.safetensors"
    save_agent(path, agent(), {"observation": "table3", "training": {"decisions": 7}})
    return path
