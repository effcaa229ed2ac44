"""Files.

Fitted generators with their description, and arrays that are kept so that they are not computed
again.
"""

from __future__ import annotations

import hashlib
import io
import json
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from ganlane._version import __version__
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS, cache_folder, has_checksum, sealed_archive, write_bytes
from ganlane.generator.networks import Generator
from ganlane.parameters.generator import EXTRA_INPUTS, GeneratorSizes, Preset
from ganlane.weights import load_weights, save_weights

KIND = "generator"
#: ``{"all" or scene: {"ERROR/KIND": value}}``.
Metrics = dict[str, dict[str, float]]


@dataclass(frozen=True)
class FitResult:
    """A fitted generator (``module``) and what it was fitted with.

    Attributes:
        metrics: on the held-out scenes, for ``"all"`` and each scene; the paper's preset also has
            ``"discriminator": {"held_out_accuracy"}``. Empty for a fold's fit: folds are scored
            together.
        config: settings of the fit, as plain data.
        data: file, rows and tracks, and the names of the fitted, validation and held-out scenes.
        statistics: ``DrivingStatistics.to_dict()`` of all recordings; for a fold's fit of its other
            scenes.
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
        self,
        path: str | Path,
        folds: Mapping[str, Any] | None = None,
        code: Mapping[str, Any] | None = None,
    ) -> None:
        """Write weights and metadata, atomically.

        ``folds`` is the result of :func:`ganlane.generator.cross_validate`, if it was called;
        ``code`` the code's version in more detail than the package's number.
        """
        metadata = {
            "preset": self.preset,
            "sizes": asdict(self.module.sizes),
            "config": self.config,
            "data": self.data,
            "metrics": {
                **self.metrics,
                "fit": {"updates": self.updates, "seconds": round(self.seconds, 1)},
            },
            "driving_statistics": self.statistics,
            "folds": None if folds is None else dict(folds),
            "code": {} if code is None else dict(code),
            "ganlane": __version__,
        }
        save_weights(path, KIND, self.module.state_dict(), metadata)


def shipped_generator(preset: Preset) -> Path:
    """Path of the weights that come with the package."""
    return CHECKPOINTS / f"generator_{preset}.safetensors"


def load_generator(
    path: str | Path, preset: Preset | None = None
) -> tuple[Generator, dict[str, Any]]:
    """The generator in evaluation mode, without gradients, and its metadata, as
    :meth:`FitResult.save` wrote them.

    ``preset`` is the required one; None accepts any.

    Raises:
        UserError: no such file, another kind of file, another preset, or weights that do not fit
            the stored sizes.
    """
    tensors, metadata = load_weights(path, KIND)
    found = str(metadata.get("preset"))
    if found not in get_args(Preset) or (preset is not None and found != preset):
        raise UserError(
            f"{path}: a generator of preset {found!r}, expected {preset or 'paper or calibrated'!r}; give one."
        )
    sizes: Any = metadata.get("sizes")
    kinds = {field.name: type(field.default) for field in fields(GeneratorSizes)}
    # Older files do not have ``differences``, which gets its default.
    complete = isinstance(sizes, dict) and set(kinds) - {"differences"} <= set(sizes) <= set(kinds)
    # The bound keeps a damaged file from requesting all memory.
    if not complete or not all(
        isinstance(value, int) and 0 <= value <= 4096 and type(value) is kinds[name]
        for name, value in sizes.items()
    ):
        raise UserError(
            f"{path}: sizes {sizes} are not those of a generator ({sorted(kinds)}); fit it again."
        )
    try:
        with torch.random.fork_rng(devices=[]):
            generator = Generator(GeneratorSizes(**sizes))
        generator.load_state_dict(tensors)
    except RuntimeError as error:
        raise UserError(
            f"{path}: its weights do not have the shapes that its sizes {sizes} ask for; fit it again."
        ) from error
    inputs, expected = generator.sizes.extra_inputs, EXTRA_INPUTS if found == "calibrated" else 0
    if inputs != expected:
        raise UserError(
            f"{path}: takes {inputs} further inputs, expected {expected} for the preset {found}; fit it again."
        )
    if not isinstance(metadata.get("driving_statistics"), dict):
        raise UserError(f"{path}: holds no driving statistics of its recordings; fit it again.")
    return generator.eval().requires_grad_(False), metadata


def content_hash(settings: Any, *arrays: np.ndarray) -> str:
    """Hash of plain settings and of the arrays' types, shapes and bytes."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


def cached(
    name: str, key: str, compute: Callable[[], dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """The arrays that ``compute`` returns, from the cache if it ran for this ``key`` before.

    A damaged file is computed again, and a folder that cannot be written to is ignored.
    """
    folder = cache_folder()
    if folder is None:
        return compute()
    path = folder / f"{name}_{key}.npz"
    arrays = load_arrays(path)
    if arrays is None:
        arrays = compute()
        with suppress(OSError):
            save_arrays(path, arrays)
    return arrays


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as .npz with a checksum, atomically."""
    file = io.BytesIO()
    # numpy's stub takes a name for an option
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    write_bytes(path, sealed_archive(file.getvalue()))


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """What :func:`save_arrays` wrote, without pickle.

    None where it is absent, with a note where damaged.
    """
    if not path.is_file():
        return None
    of_numpy = (
        KeyError,
        EOFError,
        SyntaxError,
        tokenize.TokenError,
        zipfile.BadZipFile,
        zlib.error,
    )
    with suppress(UserError, OSError, ValueError, *of_numpy):
        content = path.read_bytes()
        if has_checksum(content, path):
            with np.load(io.BytesIO(content), allow_pickle=False) as kept:
                return dict(kept)
    print(f"{path}: damaged or without a checksum; computed again.", file=sys.stderr)
    return None
