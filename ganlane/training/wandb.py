"""Weights & Biases as a further log."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ganlane.errors import UserError


class WandbLog:
    """A run of Weights & Biases below ``folder/wandb`` (extra ``wandb``).

    Offline, unless the environment variable ``WANDB_MODE`` asks for something else (``online``, ``disabled``);
    ``wandb sync FOLDER/wandb/offline-run-*`` uploads it later. A resumed training run is a further run there, which
    starts at the decisions of the checkpoint.

    Args:
        folder: of the training run; its last two parts name the run.
        project: where W&B files it.
        about: JSON-serialisable settings that W&B shows beside the figures.

    Raises:
        UserError: wandb is not installed, or does not start (``WANDB_MODE=online`` without an account, for instance).
    """

    def __init__(self, folder: str | Path, project: str = "ganlane", about: Mapping[str, Any] | None = None) -> None:
        folder = Path(folder)
        try:
            import wandb
        except ImportError as error:
            raise UserError(
                "logger=wandb: wandb is not installed; run `pip install 'ganlane[wandb]'` or use logger=csv."
            ) from error
        mode = os.environ.get("WANDB_MODE") or "offline"
        folder.mkdir(parents=True, exist_ok=True)
        name = "/".join(folder.absolute().parts[-2:])
        options: dict[str, Any] = {"project": project, "name": name, "dir": str(folder), "mode": mode}
        try:
            # Without W&B's console, which would take the progress bar's stream away.
            settings = wandb.Settings(console="off")
            self._run = wandb.init(config=dict(about or {}), settings=settings, **options)
        except (wandb.Error, ValueError) as error:
            raise UserError(
                f"logger=wandb with WANDB_MODE={mode}: W&B did not start ({error}); use WANDB_MODE=offline or "
                "logger=csv."
            ) from error

    def write(self, row: Mapping[str, float]) -> None:
        """Add every figure over the decisions."""
        figures = {name: value for name, value in row.items() if name != "decisions"}
        self._run.log(figures, step=int(row["decisions"]))

    def close(self) -> None:
        """Write out what is left."""
        self._run.finish()
