"""Saving and loading a generator: weights, and everything that says what they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from ganlane._version import __version__
from ganlane.errors import UserError
from ganlane.files import load_weights, save_weights
from ganlane.generator.anchored import EXTRA_INPUTS
from ganlane.generator.networks import Generator, GeneratorSizes
from ganlane.paths import CHECKPOINTS

KIND = "generator"
Preset = Literal["paper", "calibrated"]
#: Numbers beside the motion that each preset sees.
PRESET_INPUTS = {"paper": 0, "calibrated": EXTRA_INPUTS}
_NAMED_LATER = {"differences"}


def shipped_generator(preset: Preset) -> Path:
    """Path of the weights that come with the package."""
    return CHECKPOINTS / f"generator_{preset}.safetensors"


def save_generator(
    path: str | Path,
    generator: Generator,
    preset: Preset,
    *,
    config: Mapping[str, Any],
    data: Mapping[str, Any],
    metrics: Mapping[str, Any],
    driving_statistics: Mapping[str, Any],
    folds: Mapping[str, Any] | None = None,
    code: Mapping[str, Any] | None = None,
) -> None:
    """Save the generator with its description, atomically.

    Args:
        path: where to write.
        generator: what was fitted.
        preset: for which closed loop.
        config: what it was fitted with.
        data: the recordings: file, scenes fitted and held out, counts.
        metrics: on the held-out scenes.
        driving_statistics: ``ganlane.data.DrivingStatistics.to_dict()`` of the recordings, for the overlays.
        folds: what :func:`ganlane.generator.cross_validation.cross_validate` gave, if it was called.
        code: the code's version in more detail than the package's number.
    """
    metadata = {
        "preset": preset,
        "sizes": asdict(generator.sizes),
        "config": dict(config),
        "data": dict(data),
        "metrics": dict(metrics),
        "driving_statistics": dict(driving_statistics),
        "folds": None if folds is None else dict(folds),
        "code": {} if code is None else dict(code),
        "ganlane": __version__,
    }
    save_weights(path, KIND, generator.state_dict(), metadata)


def load_generator(path: str | Path, preset: Preset | None = None) -> tuple[Generator, dict[str, Any]]:
    """The generator in evaluation mode, without gradients, and its metadata.

    Args:
        path: what :func:`save_generator` wrote.
        preset: the one that is needed; None takes any.

    Raises:
        UserError: absent, foreign, of another preset, or its weights do not fit its own sizes.
    """
    tensors, metadata = load_weights(path, KIND)
    found = str(metadata.get("preset"))
    if found not in get_args(Preset) or (preset is not None and found != preset):
        raise UserError(
            f"{path}: a generator of preset {found!r}, expected {preset or 'paper or calibrated'!r}; give one."
        )
    generator = _build(path, metadata, tensors)
    if generator.sizes.extra_inputs != PRESET_INPUTS[found]:
        raise UserError(
            f"{path}: takes {generator.sizes.extra_inputs} further inputs, expected {PRESET_INPUTS[found]} for the "
            f"preset {found}; fit it again."
        )
    if not isinstance(metadata.get("driving_statistics"), dict):
        raise UserError(f"{path}: holds no driving statistics of its recordings; fit it again.")
    return generator.eval().requires_grad_(False), metadata


def _build(path: str | Path, metadata: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Generator:
    """Networks of the stored sizes with the stored weights; sizes named later have their defaults in older files."""
    sizes: Any = metadata.get("sizes")
    kinds = {field.name: type(field.default) for field in fields(GeneratorSizes)}
    needed = set(kinds) - _NAMED_LATER
    whole = isinstance(sizes, dict) and needed <= set(sizes) <= set(kinds)
    if not whole or not all(_is_size(value, kinds[name]) for name, value in sizes.items()):
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


def _is_size(value: Any, kind: type) -> bool:
    """A switch, or a whole number that a layer can have: bounded, so a damaged file cannot ask for all memory."""
    return isinstance(value, int) and type(value) is kind and (kind is bool or 0 <= value <= 4096)
