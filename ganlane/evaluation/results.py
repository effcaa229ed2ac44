"""What a command leaves in its run folder, as files and as an object."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from datetime import datetime, timezone
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch

from ganlane._version import __version__
from ganlane.files import PACKAGE, atomic_path, write_json


@dataclass(frozen=True, repr=False)
class Run:
    """A finished command: its run folder and the content of ``results.json``."""

    folder: Path
    results: dict[str, Any]

    def __repr__(self) -> str:
        return f"{type(self).__name__}(folder={str(self.folder)!r}, results: {', '.join(self.results)})"

    def _repr_html_(self) -> str:
        """For notebooks.

        The table of an evaluation, else the results that are single numbers or texts.
        """
        rows = self.results.get("rows")
        if not isinstance(rows, list):
            rows = [
                {
                    name: value
                    for name, value in self.results.items()
                    if isinstance(value, int | float | str)
                }
            ]
        return f"<p>{escape(str(self.folder))}</p>{pl.DataFrame(rows, infer_schema_length=None)._repr_html_()}"


@dataclass(frozen=True, repr=False)
class TrainingRun(Run):
    """A finished training: also the agent's file and the table of the final evaluation."""

    agent: Path
    table: pl.DataFrame


def write_results(
    folder: str | Path,
    numbers: Mapping[str, Any],
    config: Mapping[str, Any],
    seeds: Mapping[str, Any],
) -> Path:
    """Write ``results.json`` into ``folder`` atomically and return its path.

    Args:
        folder: of the run.
        numbers: the command's own results, for instance ``{"rows": evaluation_rows(...)}``.
        config: the whole configuration.
        seeds: the seeds and episode numbers behind the numbers.
    """
    path = Path(folder) / "results.json"
    origin = {"seeds": seeds, "config": config, "code": code_version(), "machine": machine()}
    written = datetime.now(timezone.utc).isoformat(timespec="seconds")
    write_json(path, plain({**numbers, **origin, "written": written}))
    return path


def names_of_runs(folders: Sequence[Path]) -> list[str]:
    """What tells runs apart: the options on their command lines in which they differ, else ends of
    their paths.

    ``seed=0`` comes last. Two runs of the same options, or one without its command line, are named
    by their paths.
    """
    given = [_overrides(folder) for folder in folders]
    keys = sorted({key for each in given for key in each}, key=lambda key: (key == "seed", key))
    told = [key for key in keys if len({each.get(key) for each in given}) > 1]
    names = [", ".join(f"{key}={each[key]}" for key in told if key in each) for each in given]
    for depth in range(1, max(len(folder.parts) for folder in folders) + 1):
        if all(names) and len(set(names)) == len(names):
            break
        names = ["/".join(folder.parts[-depth:]) for folder in folders]
    return names


def _overrides(folder: Path) -> dict[str, str]:
    """The command line of a run by key, the newest value of each."""
    file = folder / "overrides.yaml"
    lines = (
        re.findall(r"^- (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
        if file.is_file()
        else []
    )
    return {
        key.strip("'\" +"): value.strip("'\"")
        for key, _, value in (line.partition("=") for line in lines)
    }


def runs_below(folder: Path, file: str) -> list[Path]:
    """The folder itself if it holds ``file``, else those of its own folders that do, by number.

    Those of a sweep.
    """
    found = (
        [folder]
        if (folder / file).is_file()
        else [path.parent for path in folder.glob(f"*/{file}")]
    )
    return sorted(
        found,
        key=lambda path: (
            not path.name.isdigit(),
            int(path.name) if path.name.isdigit() else 0,
            path,
        ),
    )


def sweep_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of all comparisons of a sweep, each with its ``run`` (:func:`names_of_runs`)."""
    runs = runs_below(folder, "results.json")
    records = [json.loads((run / "results.json").read_text(encoding="utf-8")) for run in runs]
    named = zip(names_of_runs(runs) if runs else [], records)
    rows = [{"run": name, **row} for name, record in named for row in record.get("rows") or []]
    return rows if all("mean_reward" in row for row in rows) else []


def write_episodes(folder: str | Path, episodes: pl.DataFrame) -> Path:
    """Write one row per episode as ``episodes.parquet`` into ``folder`` atomically and return its
    path.
    """
    path = Path(folder) / "episodes.parquet"
    with atomic_path(path) as part:
        episodes.write_parquet(part)
    return path


def plain(value: Any) -> Any:
    """``value`` as JSON can hold it: plain numbers, strings, lists and dictionaries.

    NaN and infinity as None.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic, torch.Tensor)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple, set, range)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


def code_version() -> dict[str, Any]:
    """``version`` of the package, and ``revision`` and ``modified`` where it lies in a checkout of
    its own.

    An installed copy inside somebody else's checkout has no revision: git must know the package's
    own file.
    """
    version: dict[str, Any] = {"version": __version__, "revision": None, "modified": None}
    if _git("ls-files", "--error-unmatch", "__init__.py") is not None:
        version["revision"] = _git("rev-parse", "HEAD")
        version["modified"] = bool(_git("status", "--porcelain", "--untracked-files=no", "--", "."))
    return version


def _git(*arguments: str) -> str | None:
    """Output of a git command in the package's folder; None where git is absent or fails."""
    command = ["git", "-C", str(PACKAGE), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def machine() -> dict[str, Any]:
    """CPU, usable cores, torch's threads, system, accelerator (or None), and the versions that ran."""
    info = Path("/proc/cpuinfo")
    named = re.search(
        r"^model name\s*:(.*)$", info.read_text(errors="replace") if info.is_file() else "", re.M
    )
    return {
        "cpu": named[1].strip() if named else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "system": platform.platform(),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def machine_sentence(threads: Sequence[int]) -> str:
    """Where and on which code the figures were taken, without host names or paths.

    ``threads`` are torch's.
    """
    here, code = machine(), code_version()
    usable = f"{here['cores']} usable core{'s' if here['cores'] != 1 else ''}"
    accelerator = f", {here['accelerator']}" if here["accelerator"] else ""
    revision = (
        f" ({code['revision'][:12]}{', modified' if code['modified'] else ''})"
        if code["revision"]
        else ""
    )
    return (
        f"{here['cpu']}, {usable}{accelerator}; Python {here['python']}, torch {here['torch']} (threads: "
        f"{', '.join(map(str, threads))}); ganlane {code['version']}{revision}."
    )
