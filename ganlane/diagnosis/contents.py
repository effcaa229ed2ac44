"""What is read and written: configuration, shipped weights, recordings, cache, run folders."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

from ganlane.diagnosis.finding import BROKEN, Finding, State, guarded
from ganlane.errors import UserError

#: Weights without which the commands' defaults do not run.
NEEDED: Final = ("agent_idm", "generator_paper", "generator_calibrated")
_REINSTALL: Final = "python -m pip install --force-reinstall --no-deps PATH_OF_THE_CHECKOUT_OR_WHEEL"


def contents() -> list[Finding]:
    """All files and folders that matter."""
    looked = [guarded(name, look, BROKEN) for name, look in (("recordings", recordings), ("cache", cache))]
    return [configuration(), *checkpoints(), *looked, outputs()]


def configuration() -> Finding:
    """The YAML files of the commands."""

    def look() -> Finding:
        from ganlane.paths import conf_folder

        return Finding("configuration", State.OK, str(conf_folder()))

    return guarded("configuration", look, _REINSTALL)


def checkpoints() -> list[Finding]:
    """The weights that ship, each of them loaded."""
    from ganlane.paths import CHECKPOINTS

    names = sorted({*NEEDED, *(path.stem for path in CHECKPOINTS.glob("*.safetensors"))})
    return [guarded(name, _loaded(name, CHECKPOINTS / f"{name}.safetensors"), _REINSTALL) for name in names]


def _loaded(name: str, path: Path) -> Callable[[], Finding]:
    def look() -> Finding:
        if name.startswith("generator_"):
            from ganlane.generator import load_generator

            load_generator(path)
        else:
            from ganlane.agents import load_agent

            load_agent(path)
        return Finding(name, State.OK, f"{path} ({_megabytes(path)})")

    return look


def recordings() -> Finding:
    """The recordings that ``data.path=null`` means; needed for fitting and realism, not for training or driving."""
    from ganlane.data.download import DATA_VARIABLE, SCENES, default_scenes

    try:
        path = default_scenes()
    except UserError as error:
        mend = f"export {DATA_VARIABLE}=FOLDER   (one that holds {SCENES}), or give data.path=FILE (docs/own_data.md)"
        return Finding("recordings", State.ABSENT, str(error).partition("; ")[0], mend)
    return Finding("recordings", State.OK, f"{path} ({_megabytes(path)})")


def cache() -> Finding:
    """Where groups of windows are kept between fits."""
    from ganlane.generator.windows import CACHE_VARIABLE, cache_folder

    folder = cache_folder()
    if folder is None:
        return Finding("cache", State.OK, f"off ({CACHE_VARIABLE} is empty)")
    if not _can_write(folder):
        return Finding("cache", State.ABSENT, f"{folder} cannot be written to", f"export {CACHE_VARIABLE}=FOLDER")
    kept = list(folder.glob("*.npz")) if folder.is_dir() else []
    size = sum(path.stat().st_size for path in kept) / 2**20
    return Finding("cache", State.OK, f"{folder} ({len(kept)} files, {size:.1f} MB)")


def outputs() -> Finding:
    """Where the commands put their run folders."""
    folder = Path("outputs").resolve()
    if _can_write(folder):
        return Finding("run folders", State.OK, f"below {folder}")
    return Finding("run folders", State.MISSING, f"{folder} cannot be written to", "cd to a folder of your own")


def _can_write(folder: Path) -> bool:
    """Whether files can be made in ``folder``, or it can be made."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return there.is_dir() and os.access(there, os.W_OK)


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 2**20:.1f} MB"
