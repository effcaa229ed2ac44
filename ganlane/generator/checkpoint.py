"""A fitted generator with its description, saved and loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from ganlane._version import __version__
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS
from ganlane.generator.forecasts import Metrics
from ganlane.generator.networks import Generator
from ganlane.parameters.generator import EXTRA_INPUTS, GeneratorSizes, Preset
from ganlane.weights import load_weights, save_weights

KIND = "generator"
#: Inputs in addition to the motion, by preset.
PRESET_INPUTS = {"paper": 0, "calibrated": EXTRA_INPUTS}
#: Sizes that older files do not have; they get their defaults.
_ADDED_LATER = {"differences"}


@dataclass(frozen=True)
class FitResult:
    """A fitted generator and what it was fitted with.

    Attributes:
        module: the generator with the weights that were best on the validation scenes.
        metrics: of these weights on the held-out scenes, for ``"all"`` and each scene; the paper's preset also has
            ``"discriminator": {"held_out_accuracy"}``. Empty for a fold's fit: folds are scored together.
        config: settings of the fit, as plain data.
        data: file, rows and tracks, and the names of the fitted, validation and held-out scenes.
        statistics: ``DrivingStatistics.to_dict()`` of all recordings; for a fold's fit of its other scenes.
        updates: updates after which the weights were taken (early stopping).
        seconds: duration of the fit, with its evaluations on the validation scenes.
    """

    preset: Preset
    module: Generator
    metrics: Metrics
    config: dict[str, Any]
    data: dict[str, Any]
    statistics: dict[str, Any]
    updates: int
    seconds: float

    def save(
        self, path: str | Path, folds: Mapping[str, Any] | None = None, code: Mapping[str, Any] | None = None
    ) -> None:
        """Write weights and metadata, atomically.

        ``folds`` is the result of :func:`ganlane.generator.cross_validate`, if it was called; ``code`` the code's
        version in more detail than the package's number.
        """
        metadata = {
            "preset": self.preset,
            "sizes": asdict(self.module.sizes),
            "config": self.config,
            "data": self.data,
            "metrics": {**self.metrics, "fit": {"updates": self.updates, "seconds": round(self.seconds, 1)}},
            "driving_statistics": self.statistics,
            "folds": None if folds is None else dict(folds),
            "code": {} if code is None else dict(code),
            "ganlane": __version__,
        }
        save_weights(path, KIND, self.module.state_dict(), metadata)


def shipped_generator(preset: Preset) -> Path:
    """Path of the weights that come with the package."""
    return CHECKPOINTS / f"generator_{preset}.safetensors"


def load_generator(path: str | Path, preset: Preset | None = None) -> tuple[Generator, dict[str, Any]]:
    """The generator in evaluation mode, without gradients, and its metadata, as :meth:`FitResult.save` wrote them.

    ``preset`` is the required one; None accepts any.

    Raises:
        UserError: no such file, another kind of file, another preset, or weights that do not fit the stored sizes.
    """
    tensors, metadata = load_weights(path, KIND)
    found = str(metadata.get("preset"))
    if found not in get_args(Preset) or (preset is not None and found != preset):
        raise UserError(
            f"{path}: a generator of preset {found!r}, expected {preset or 'paper or calibrated'!r}; give one."
        )
    generator = _generator_of(path, metadata.get("sizes"), tensors)
    if generator.sizes.extra_inputs != PRESET_INPUTS[found]:
        raise UserError(
            f"{path}: takes {generator.sizes.extra_inputs} further inputs, expected {PRESET_INPUTS[found]} for the "
            f"preset {found}; fit it again."
        )
    if not isinstance(metadata.get("driving_statistics"), dict):
        raise UserError(f"{path}: holds no driving statistics of its recordings; fit it again.")
    return generator.eval().requires_grad_(False), metadata


def _generator_of(path: str | Path, sizes: Any, tensors: Mapping[str, Tensor]) -> Generator:
    """A generator of the stored sizes with the stored weights."""
    kinds = {field.name: type(field.default) for field in fields(GeneratorSizes)}
    complete = isinstance(sizes, dict) and set(kinds) - _ADDED_LATER <= set(sizes) <= set(kinds)
    # The bound keeps a damaged file from requesting all memory.
    if not complete or not all(
        isinstance(value, int) and 0 <= value <= 4096 and type(value) is kinds[name] for name, value in sizes.items()
    ):
        raise UserError(f"{path}: sizes {sizes} are not those of a generator ({sorted(kinds)}); fit it again.")
    try:
        with torch.random.fork_rng(devices=[]):
            generator = Generator(GeneratorSizes(**sizes))
        generator.load_state_dict(dict(tensors))
    except RuntimeError as error:
        raise UserError(
            f"{path}: its weights do not have the shapes that its sizes {sizes} ask for; fit it again."
        ) from error
    return generator
