"""The fitting loop of both presets: updates, evaluations on validation scenes, early stopping, resuming."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from ganlane.checksums import has_checksum, note_without_checksum, sealed_archive
from ganlane.errors import UserError
from ganlane.files import write_bytes
from ganlane.parameters.generator import LoopConfig


@dataclass(frozen=True)
class Progress:
    """State of a fit after ``update`` of at most ``updates``, ``seconds`` after the start of this run.

    ``losses`` are the last update's; ``score`` is the last evaluation's (lower is better), ``best`` the lowest.
    """

    update: int
    updates: int
    losses: dict[str, float]
    score: float | None
    best: float
    seconds: float


OnProgress = Callable[[Progress], None]


class FitTask(Protocol):
    """What a loop fits: networks, their optimisers, one update, one evaluation."""

    modules: dict[str, nn.Module]
    optimisers: dict[str, torch.optim.Optimizer]
    random: torch.Generator

    def update(self, number: int) -> dict[str, float]:
        """Do update ``number`` and return its losses."""

    def evaluate(self) -> float:
        """Score on the validation scenes; lower is better."""


class FitLoop:
    """Runs a task until it stops improving.

    Args:
        resume_path: file that keeps the state after every evaluation; the fit resumes from it if it exists.

    ``seconds`` is the time that the updates took, in earlier runs of the same fit too.
    """

    def __init__(self, task: FitTask, config: LoopConfig, resume_path: str | Path | None = None):
        self.task, self.config = task, config
        self.path = None if resume_path is None else Path(resume_path)
        self.done, self.waited, self.best_update, self.best = 0, 0, 0, math.inf
        self.seconds = 0.0
        self.best_weights: dict[str, dict[str, Tensor]] = {}
        if self.path is not None and self.path.exists():
            self._resume(self.path)

    def run(self, on_progress: OnProgress | None = None) -> None:
        """Fit, then put the best weights into the task's networks."""
        begun, earlier, score = time.monotonic(), self.seconds, None
        while self.done < self.config.updates and self.waited < self.config.patience:
            for optimiser in self.task.optimisers.values():
                optimiser.param_groups[0]["lr"] = learning_rate(self.config, self.done)
            losses = self.task.update(self.done)
            self.done += 1
            seconds = time.monotonic() - begun
            self.seconds = earlier + seconds
            late = self.config.max_seconds is not None and seconds > self.config.max_seconds
            if self.done % self.config.evaluate_every == 0 or self.done == self.config.updates or late:
                score = self._evaluate()
            if on_progress is not None:
                on_progress(Progress(self.done, self.config.updates, losses, score, self.best, seconds))
            if late:
                break
        for name, weights in self.best_weights.items():
            self.task.modules[name].load_state_dict(weights)

    def _evaluate(self) -> float:
        score = self.task.evaluate()
        self.waited += 1
        if score < self.best:
            self.best, self.best_update, self.waited = score, self.done, 0
            self.best_weights = {name: deepcopy(module.state_dict()) for name, module in self.task.modules.items()}
        if self.path is not None:
            file = io.BytesIO()
            torch.save(self._state(), file)
            write_bytes(self.path, sealed_archive(file.getvalue()))
        return score

    def _state(self) -> dict[str, Any]:
        """Counters, weights, optimisers and the random generator: tensors and plain data."""
        return {
            "counters": [self.done, self.waited, self.best_update],
            "best": self.best,
            "seconds": self.seconds,
            "best_weights": self.best_weights,
            "modules": {name: module.state_dict() for name, module in self.task.modules.items()},
            "optimisers": {name: optimiser.state_dict() for name, optimiser in self.task.optimisers.items()},
            "random": self.task.random.get_state(),
        }

    def _resume(self, path: Path) -> None:
        """Continue from a stored state; reading it never executes code."""
        content = path.read_bytes()
        whole = has_checksum(content, path)
        try:
            state = torch.load(io.BytesIO(content), weights_only=True)
            if "counters" not in state:
                raise ValueError("no counters")
        except Exception as error:
            raise UserError(
                f"{path}: not the state of a fit; give the file that a fit keeps, or remove it."
            ) from error
        try:
            for name, module in self.task.modules.items():
                module.load_state_dict(state["modules"][name])
            for name, optimiser in self.task.optimisers.items():
                optimiser.load_state_dict(state["optimisers"][name])
        except (KeyError, RuntimeError, ValueError) as error:
            raise UserError(
                f"{path}: holds another fit than the one asked for; give the same preset and sizes or remove it."
            ) from error
        self.done, self.waited, self.best_update = state["counters"]
        self.best, self.best_weights = state["best"], state["best_weights"]
        self.seconds = state["seconds"]
        self.task.random.set_state(state["random"])
        if not whole:
            note_without_checksum(path)


def learning_rate(config: LoopConfig, number: int) -> float:
    """Linear warm-up, then a half cosine to 0."""
    rise = min(1.0, (number + 1) / max(1, config.warmup))
    return config.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * number / config.updates))


def descend(optimiser: torch.optim.Optimizer, loss: Tensor, largest: float) -> None:
    """One step of ``optimiser`` down ``loss``, with the norm of its parameters' gradient clipped at ``largest``."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(optimiser.param_groups[0]["params"], largest)
    optimiser.step()
