"""Fitted generators and policies as files: weights with a description of the fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from ganlane._version import __version__
from ganlane.generator.human_estimator import HumanModel
from ganlane.generator.networks import Generator
from ganlane.settings.generator import (
    GENERATOR,
    FitConfig,
    Preset,
    human_sizes,
    misfit,
    stored_sizes,
)
from ganlane.weights import load_weights, save_weights

Network = TypeVar("Network", bound=nn.Module)


@dataclass(frozen=True)
class FitResult:
    """A fitted generator (``module``) and what it was fitted with.

    Attributes:
        config: settings of the fit, with its preset.
        metrics: errors on the held-out scenes, ``"all"`` and by scene
            (:func:`ganlane.generator.forecasts.displacement_errors`).
        data: file, rows and tracks, and the names of the fitted, validation and held-out scenes.
        statistics: ``DrivingStatistics.to_dict()`` of all recordings.
        updates: updates after which the weights were taken (early stopping).
        seconds: duration of the fit, with its evaluations on the validation scenes.
    """

    config: FitConfig
    module: Generator | HumanModel
    metrics: dict[str, Any]
    data: dict[str, Any]
    statistics: dict[str, Any]
    updates: int
    seconds: float

    def save(
        self,
        path: str | Path,
        folds: Mapping[str, Any] | None = None,
        code: Mapping[str, Any] | None = None,
    ) -> None:
        """Write weights and metadata, atomically.

        Args:
            path: of the file.
            folds: scores of :func:`ganlane.generator.cross_validate`, if it was called.
            code: the code's version in more detail than the package's number.
        """
        fit = {"updates": self.updates, "seconds": round(self.seconds, 1)}
        # Plain data only: reading a file of weights never executes code.
        metadata = {
            "preset": self.config.preset,
            "sizes": asdict(self.module.sizes),
            "config": asdict(self.config),
            "data": self.data,
            "metrics": {**self.metrics, "fit": fit},
            "driving_statistics": self.statistics,
            "folds": folds,
            "code": code or {},
            "ganlane": __version__,
        }
        save_weights(path, GENERATOR, self.module.state_dict(), metadata)


def load_generator(
    path: str | Path, preset: Preset | None = None
) -> tuple[Generator, dict[str, Any]]:
    """A generator in evaluation mode, without gradients, and its metadata.

    The metadata are as :meth:`FitResult.save` wrote them.

    Args:
        path: of a file that :meth:`FitResult.save` wrote.
        preset: that is required; None: any.

    Raises:
        UserError: no such file, another kind of file, another preset, or weights that do not fit
            the stored sizes.
    """
    tensors, metadata = load_weights(path, GENERATOR)
    sizes = stored_sizes(path, metadata, preset)
    return with_weights(Generator, sizes, tensors, path), metadata


def load_human(path: str | Path) -> tuple[HumanModel, dict[str, Any]]:
    """A model of ``human`` in evaluation mode, without gradients, and its metadata.

    Raises:
        UserError: no such file, another kind of file or preset, or weights that do not fit the
            stored sizes.
    """
    tensors, metadata = load_weights(path, GENERATOR)
    return with_weights(HumanModel, human_sizes(path, metadata), tensors, path), metadata


def with_weights(
    kind: Callable[[Any], Network],
    sizes: Any,
    weights: Mapping[str, Any],
    path: object = "weights",
) -> Network:
    """A network with these tensors or arrays, in evaluation mode, without gradients.

    Raises:
        UserError: they have other names or shapes; ``path`` is for the message.
    """
    # A file that is read must not change the caller's random numbers.
    with torch.random.fork_rng(devices=[]):
        network = kind(sizes)
    try:
        # Strict: a missing tensor or one too many is an error, too.
        network.load_state_dict({name: torch.as_tensor(value) for name, value in weights.items()})
    except RuntimeError as error:
        raise misfit(path, asdict(sizes)) from error
    # A network that drives is not fitted further, and gradients would cost memory.
    return network.eval().requires_grad_(False)
