"""When and where a run is saved."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ganlane.agents import save_agent
from ganlane.training.checkpoints import LAST, save_checkpoint
from ganlane.training.config import TrainingConfig
from ganlane.training.run import Run

#: A checkpoint that took t seconds to write is followed by the next after 50 t at the earliest: 2 % of the time.
PATIENCE = 50.0


class Saver:
    """Writes ``checkpoints/last.pt`` (to resume), ``last.safetensors`` and ``best.safetensors`` (to drive).

    Args:
        run: to be saved.
        folder: of the run.
        config: how often, and whether with the replay buffer.
        metadata: goes into the agent's files; what is known of the training is added under ``training``.
    """

    def __init__(self, run: Run, folder: str | Path, config: TrainingConfig, metadata: Mapping[str, Any]) -> None:
        self.run, self.folder, self.config, self.metadata = run, Path(folder), config, metadata
        self.saved_s, self.pause_s = time.monotonic(), config.checkpoint_every_s

    @property
    def path(self) -> Path:
        """The checkpoint to resume from."""
        return self.folder / LAST

    def due(self) -> bool:
        """Whether it is time for the next checkpoint."""
        return time.monotonic() - self.saved_s > self.pause_s

    def save(self) -> None:
        """Write the checkpoint and the present weights."""
        begun = time.monotonic()
        save_checkpoint(self.path, self.run.state_dict(self.config.checkpoint_replay))
        self.save_weights("last", {})
        self.saved_s = time.monotonic()
        self.pause_s = max(self.config.checkpoint_every_s, PATIENCE * (self.saved_s - begun))

    def save_weights(self, name: str, figures: Mapping[str, Any]) -> None:
        """Write the online network as ``NAME.safetensors``, with ``figures`` in its metadata."""
        run = self.run
        known = {"decisions": run.decisions, "updates": run.agent.updates, "wall_s": run.wall_s}
        training = {**self.metadata.get("training", {}), **known, **figures}
        path = self.path.with_name(f"{name}.safetensors")
        save_agent(path, run.agent, {**self.metadata, "training": training})
