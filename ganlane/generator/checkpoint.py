"""Fitted generators as files: weights with a description of the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

import torch

from ganlane._version import __version__
from ganlane.errors import ParameterError, UserError
from ganlane.files import CHECKPOINTS
from ganlane.generator.networks import Generator
from ganlane.settings.generator import (
    EXTRA_INPUTS,
    FitConfig,
    GeneratorSizes,
    Preset,
)
from ganlane.weights import load_weights, save_weights

#: Written into the file; weights of another kind, such as an agent's, are refused by it.
KIND = "generator"
#: ``{"all" or scene: {"ERROR/KIND": value}}``.
Metrics = dict[str, dict[str, float]]


@dataclass(frozen=True)
class FitResult:
    """A fitted generator (``module``) and what it was fitted with.

    Attributes:
        config: settings of the fit, with its preset.
        metrics: on the held-out scenes, for ``"all"`` and each scene; the paper's preset also has
            ``"discriminator": {"held_out_accuracy"}``. Empty for a fold's fit: folds are scored
            together.
        data: file, rows and tracks, and the names of the fitted, validation and held-out scenes.
        statistics: ``DrivingStatistics.to_dict()`` of all recordings; for a fold's fit of its other
            scenes.
        updates: updates after which the weights were taken (early stopping).
        seconds: duration of the fit, with its evaluations on the validation scenes.
    """

    config: FitConfig
    module: Generator
    metrics: Metrics
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

        ``folds`` are the scores of :func:`ganlane.generator.cross_validate`, if it was called;
        ``code`` the code's version in more detail than the package's number.
        """
        fit = {
            "updates": self.updates,
            "seconds": round(self.seconds, 1),
        }
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
        save_weights(
            path,
            KIND,
            self.module.state_dict(),
            metadata,
        )


def shipped_generator(preset: Preset) -> Path:
    """Path of the weights that come with the package."""
    return CHECKPOINTS / f"generator_{preset}.safetensors"


def load_generator(
    path: str | Path, preset: Preset | None = None
) -> tuple[Generator, dict[str, Any]]:
    """A generator in evaluation mode, without gradients, and its metadata.

    The metadata are as :meth:`FitResult.save` wrote them. ``preset`` is the required one; None
    accepts any.

    Raises:
        UserError: no such file, another kind of file, another preset, or weights that do not fit
            the stored sizes.
    """
    tensors, metadata = load_weights(path, KIND)
    # str, since a foreign file may hold anything under this name.
    stored = str(metadata.get("preset"))
    if stored not in get_args(Preset) or (preset is not None and stored != preset):
        expected = preset or "paper or calibrated"
        raise UserError(
            f"{path}: a generator of preset {stored!r}, expected {expected!r}; give one."
        )
    generator = _sized_generator(path, metadata.get("sizes"))
    # Strict: a missing tensor or one too many is an error, too.
    try:
        generator.load_state_dict(tensors)
    except RuntimeError as error:
        raise UserError(
            f"{path}: its weights do not have the shapes that its sizes ask for; fit it again."
        ) from error
    # The presets differ in their inputs; weights of one would drive badly under the other's name.
    inputs = generator.sizes.extra_inputs
    needed = EXTRA_INPUTS if stored == "calibrated" else 0
    if inputs != needed:
        raise UserError(
            f"{path}: takes {inputs} further inputs, expected {needed} for the preset {stored}; "
            "fit it again."
        )
    # Traffic takes headways and lane changes from them, so weights alone cannot drive.
    if not isinstance(metadata.get("driving_statistics"), dict):
        raise UserError(f"{path}: holds no driving statistics of its recordings; fit it again.")
    # A generator that drives is not fitted further, and gradients would cost memory.
    return generator.eval().requires_grad_(False), metadata


def _sized_generator(path: str | Path, sizes: Any) -> Generator:
    """A generator of the stored ``sizes``; their ranges keep a file from requesting all memory."""
    # The defaults tell the types, since a text or a float would fail only inside torch.
    types = {field.name: type(field.default) for field in fields(GeneratorSizes)}
    try:
        if {name: type(size) for name, size in dict(sizes).items()} != types:
            raise ValueError("other names or types")
        # A file that is read must not change the caller's random numbers.
        with torch.random.fork_rng(devices=[]):
            return Generator(GeneratorSizes(**sizes))
    except (
        TypeError,
        ValueError,
        RuntimeError,
        ParameterError,
    ) as error:
        raise UserError(
            f"{path}: sizes {sizes} are not those of a generator ({sorted(types)}); fit it again."
        ) from error
