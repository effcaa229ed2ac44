"""Versions of Python and of what the package stands on, held against the ranges of ``pyproject.toml``."""

from __future__ import annotations

import importlib
import platform
import re
import sys
from importlib import metadata
from typing import Final, NamedTuple

from ganlane.diagnosis.finding import Finding, State, guarded

PYTHON: Final = (3, 10)
#: As in ``pyproject.toml``; a test holds the two against each other.
REQUIRED: Final = (
    "torch>=2.11,<2.14",
    "torchrl>=0.14.1,<0.15",
    "tensordict>=0.14.3,<0.15",
    "gymnasium>=1.1,<2",
    "hydra-core>=1.3.2,<1.4",
    "matplotlib>=3.8",
    "numpy>=1.26",
    "polars>=1.20",
    "pillow>=10.1",
    "safetensors>=0.4.5",
    "scikit-learn>=1.4",
    "scipy>=1.11",
    "tqdm>=4.66",
)
#: Extra to what it is for and what it brings, as in ``pyproject.toml``.
EXTRAS: Final = {
    "video": ("films as mp4", ("imageio>=2.34", "imageio-ffmpeg>=0.5")),
    "tensorboard": ("logger=tensorboard", ("tensorboard>=2.16",)),
    "bench": (
        "peers of ganlane bench",
        ("highway-env>=1.10", "stable-baselines3>=2.4", "eclipse-sumo>=1.20", "libsumo>=1.20"),
    ),
    "sumo": ("traffic=sumo", ("eclipse-sumo>=1.20", "libsumo>=1.20")),
    "wandb": ("logger=wandb", ("wandb>=0.18",)),
    "ray": ("distributed collection", ("ray>=2.40",)),
    "sweeps": ("sweeps in several processes", ("hydra-joblib-launcher>=1.2",)),
    "slurm": ("sweeps as Slurm jobs", ("hydra-submitit-launcher>=1.2",)),
    "ray-sweeps": ("sweeps on a Ray cluster", ("hydra-ray-launcher>=1.2.1",)),
    "docs": ("building these pages", ("mkdocs-material>=9.5", "mkdocstrings[python]>=0.27")),
}
#: Distributions whose module has another name.
MODULES: Final = {"hydra-core": "hydra", "pillow": "PIL", "scikit-learn": "sklearn"}


class Requirement(NamedTuple):
    """A distribution and the versions that will do."""

    name: str
    ranges: tuple[tuple[str, str], ...]

    def allows(self, version: str) -> bool:
        """Whether ``version`` is in all ranges."""
        found = numbers(version)
        return all(found >= numbers(limit) if sign == ">=" else found < numbers(limit) for sign, limit in self.ranges)


def parsed(text: str) -> Requirement:
    """``torch>=2.11,<2.14`` taken apart."""
    name = re.match(r"[\w.-]+", text)
    if name is None:
        raise ValueError(text)
    return Requirement(name[0], tuple(re.findall(r"(>=|<)([\d.]+)", text)))


def numbers(version: str) -> tuple[int, ...]:
    """The release as numbers, without what follows: (2, 13, 0) for ``2.13.0+cpu``; zeros at the end do not count."""
    found = re.match(r"\d+(\.\d+)*", version)
    release = [int(part) for part in found[0].split(".")] if found else []
    while release and release[-1] == 0:
        release.pop()
    return tuple(release)


def install(*requirements: str) -> str:
    """The command that installs them."""
    quoted = (f'"{text}"' for text in requirements)
    return f"python -m pip install {' '.join(quoted)}"


def python() -> Finding:
    """The interpreter."""
    found = f"{platform.python_version()} ({sys.executable})"
    if sys.version_info >= PYTHON:
        return Finding("python", State.OK, found)
    wanted = ".".join(map(str, PYTHON))
    return Finding("python", State.MISSING, found, f"a virtual environment with Python {wanted} or newer")


def required(text: str) -> Finding:
    """Whether what is needed is installed, new and old enough, and can be imported."""
    requirement = parsed(text)
    name, version = requirement.name, version_of(requirement.name)
    if version is None:
        return Finding(name, State.MISSING, "not installed", install(text))
    if not requirement.allows(version):
        return Finding(name, State.MISSING, f"{version}, needed {text.removeprefix(name)}", install(text))

    def look() -> Finding:
        importlib.import_module(MODULES.get(name, name))
        return Finding(name, State.OK, version)

    return guarded(name, look, f"{install(text)} --force-reinstall")


def extra(name: str) -> Finding:
    """Whether everything of an extra is installed; nothing of it is imported."""
    purpose, texts = EXTRAS[name]
    versions = {text: version_of(parsed(text).name) for text in texts}
    lacking = [text for text, version in versions.items() if version is None or not parsed(text).allows(version)]
    if lacking:
        without = ", ".join(parsed(text).name for text in lacking)
        return Finding(f"extra {name}", State.ABSENT, f"{purpose}: {without} not installed", install(*lacking))
    return Finding(f"extra {name}", State.OK, ", ".join(f"{parsed(text).name} {versions[text]}" for text in texts))


def version_of(name: str) -> str | None:
    """The installed version of a distribution; None where it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def software() -> list[Finding]:
    """Python and what is needed."""
    return [python(), *map(required, REQUIRED)]


def extras() -> list[Finding]:
    """What can be added."""
    return [extra(name) for name in EXTRAS]
