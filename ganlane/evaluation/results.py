"""What a command leaves in its run folder, as files and as an object."""

from __future__ import annotations

import json
import math
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
from ganlane.errors import UserError, as_typed
from ganlane.files import PACKAGE, opened, write_json
from ganlane.runtime import usable_cores
from ganlane.settings.record import saved_config
from ganlane.settings.traffic import OwnTraffic, TrafficConfig


@dataclass(frozen=True, repr=False)
class Run:
    """A finished command.

    Attributes:
        folder: of the run.
        results: the content of its ``results.json``.
    """

    folder: Path
    results: dict[str, Any]

    def __repr__(self) -> str:
        names = ", ".join(self.results)
        return f"{type(self).__name__}(folder={str(self.folder)!r}, results: {names})"

    def _repr_html_(self) -> str:
        """For notebooks.

        The table of an evaluation, else the results that are single numbers or texts.
        """
        # A table needs rows; other commands leave single numbers.
        rows = self.results.get("rows")
        if not isinstance(rows, list):
            single = int | float | str
            rows = [
                {key: value for key, value in self.results.items() if isinstance(value, single)}
            ]

        table = pl.DataFrame(rows, infer_schema_length=None)._repr_html_()
        return f"<p>{escape(str(self.folder))}</p>{table}"


@dataclass(frozen=True, repr=False)
class TrainingRun(Run):
    """A finished training: also the agent's file and the table of the final evaluation."""

    agent: Path
    table: pl.DataFrame


def seeds_of(config: Any) -> dict[str, Any]:
    """What :func:`write_results` is told of the episodes of a command that drives the first ones of
    its seed.
    """
    return {
        "stream": config.stream,
        "seed": config.seed,
        "episodes": [0, config.episodes - 1],
    }


def write_results(
    folder: str | Path,
    numbers: Mapping[str, Any],
    config: Any,
    seeds: Mapping[str, Any],
) -> Path:
    """Write ``results.json`` into ``folder`` atomically and return its path.

    Args:
        folder: of the run.
        numbers: the command's own results, for instance ``{"rows": evaluation_rows(...)}``.
        config: the record of the command's settings.
        seeds: the seeds and episode numbers behind the numbers.
    """
    path = Path(folder) / "results.json"

    # Whoever finds the file later can tell where its numbers come from.
    content = {
        **numbers,
        "seeds": seeds,
        "config": config,
        "code": code_version(),
        "machine": machine(),
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    write_json(path, as_json(content))
    return path


def names_of_runs(folders: Sequence[Path]) -> list[str]:
    """What tells runs apart: the settings in which they differ.

    ``seed=0`` comes last. Two runs of the same settings, or one without its settings, are named by
    the ends of their paths.

    Args:
        folders: of the runs, each with its ``config.yaml``.

    Returns:
        A name for each of them, in their order.
    """
    runs = [_settings(folder) for folder in folders]

    differing = []
    for key in runs[0] if runs else ():
        # A key that some lack belongs to a traffic or a scene that they do not have.
        shared = all(key in settings for settings in runs)
        if shared and len({settings[key] for settings in runs}) > 1:
            differing.append(key)

    # Alphabetical, so that the order does not depend on which run comes first.
    differing.sort(key=lambda key: (key == "seed", key))

    names = []
    for settings in runs:
        names.append(", ".join(f"{key}={settings[key]}" for key in differing))

    # Paths from the right, as long as it takes to tell all of them apart.
    longest = max((len(folder.parts) for folder in folders), default=0)
    for depth in range(1, longest + 1):
        if all(names) and len(set(names)) == len(names):
            break
        names = ["/".join(folder.parts[-depth:]) for folder in folders]
    return names


def _settings(folder: Path) -> dict[str, str]:
    """The settings of a run by dotted key, as they are typed; empty where it has none."""
    try:
        data = saved_config(folder / "config.yaml")
    except UserError:
        return {}

    # Which checkpoint a run went on from does not tell what it is.
    data.pop("resume", None)

    settings = {}
    for key, value in flat(data).items():
        owner, _, name = key.rpartition(".")
        if name == "_target_":
            # A traffic is known by its option, one of the user's own by its import path.
            kind = TrafficConfig.kinds().get(str(value), OwnTraffic)
            settings[owner] = kind.option or as_typed(value)  # type: ignore[attr-defined]
        else:
            settings[key] = as_typed(value)

    # The traffics of an evaluation by their names alone.
    if isinstance(data.get("traffics"), Mapping):
        settings["traffics"] = as_typed(list(data["traffics"]))
    return settings


def flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested plain data by dotted name; tuples become lists, as when read from a file.

    Args:
        nested: mappings in mappings; an empty one is a value.
        above: what stands before every name, with its dot.
    """
    names: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping) and value:
            names |= flat(value, f"{above}{name}.")
        else:
            names[f"{above}{name}"] = list(value) if isinstance(value, tuple) else value
    return names


def runs_below(folder: Path, file: str) -> list[Path]:
    """The folder itself if it holds ``file``, else the runs of a sweep in it, by number.

    Only those that hold ``file``; an empty list where none does.
    """
    if (folder / file).is_file():
        return [folder]

    runs = [path.parent for path in folder.glob(f"*/{file}")]

    def order(path: Path) -> tuple[bool, int, Path]:
        if path.name.isdigit():
            return False, int(path.name), path
        return True, 0, path

    # Job 10 comes after job 9, and what is not a job after all of them.
    return sorted(runs, key=order)


def sweep_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of all comparisons of a sweep, each with its ``run`` (:func:`names_of_runs`).

    No rows where the runs are of other commands.
    """
    runs = runs_below(folder, "results.json")

    rows = []
    for name, run in zip(names_of_runs(runs), runs):
        record = json.loads((run / "results.json").read_text(encoding="utf-8"))
        rows += [{"run": name, **row} for row in record.get("rows") or []]

    # Rows of other commands have other columns, so they make no common table.
    return rows if all("mean_reward" in row for row in rows) else []


def write_episodes(folder: str | Path, episodes: pl.DataFrame) -> Path:
    """Write one row per episode as ``episodes.parquet`` into ``folder``, atomically; its path."""
    path = Path(folder) / "episodes.parquet"
    # A reader never sees half a file.
    with opened(path) as file:
        episodes.write_parquet(file)
    return path


def as_json(value: Any) -> Any:
    """``value`` as JSON can hold it: plain numbers, strings, lists and dictionaries.

    NaN and infinity as None.
    """
    # Records first: they hold everything below.
    if is_dataclass(value) and not isinstance(value, type):
        return as_json(asdict(value))

    if isinstance(value, Mapping):
        return {str(key): as_json(item) for key, item in value.items()}

    # A tensor or an array becomes nested lists, a scalar of theirs a plain number.
    if isinstance(value, (np.ndarray, np.generic, torch.Tensor)):
        return as_json(value.tolist())
    if isinstance(value, (list, tuple, set, range)):
        return [as_json(item) for item in value]

    # JSON has neither NaN nor infinity.
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    # Paths and the like.
    return str(value)


def code_version() -> dict[str, Any]:
    """``version`` of the package; ``revision`` and ``modified`` in a checkout of its own.

    An installed copy inside somebody else's checkout has no revision: git must know the package's
    own file.
    """
    # None where git does not know: an installed package, or a machine without git.
    revision = None
    modified = None
    if _git("ls-files", "--error-unmatch", "__init__.py") is not None:
        revision = _git("rev-parse", "HEAD")
        # The package alone: changed tests or docs change no number.
        modified = bool(_git("status", "--porcelain", "--untracked-files=no", "--", "."))
    return {"version": __version__, "revision": revision, "modified": modified}


def _git(*arguments: str) -> str | None:
    """Output of a git command in the package's folder; None where git is absent or fails."""
    command = ["git", "-C", str(PACKAGE), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def machine() -> dict[str, Any]:
    """CPU, usable cores, torch's threads, system, accelerator (or None), versions that ran."""
    cpu = platform.processor() or platform.machine()

    # Linux names the model of the CPU here.
    info = Path("/proc/cpuinfo")
    if info.is_file():
        model = re.search(r"(?m)^model name\s*:(.*)$", info.read_text(errors="replace"))
        cpu = model[1].strip() if model else cpu

    accelerator = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "cpu": cpu,
        "cores": usable_cores(),
        "threads": torch.get_num_threads(),
        "system": platform.platform(),
        "accelerator": accelerator,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def machine_sentence(threads: Sequence[int]) -> str:
    """Where and on which code the figures were taken, without host names or paths.

    ``threads`` are torch's.
    """
    here = machine()
    code = code_version()

    # The model of CPU and accelerator decides about speed.
    plural = "s" if here["cores"] != 1 else ""
    hardware = f"{here['cpu']}, {here['cores']} usable core{plural}"
    if here["accelerator"]:
        hardware += f", {here['accelerator']}"

    # The versions decide about digits.
    used = f"Python {here['python']}, torch {here['torch']}"
    version = f"ganlane {code['version']}"
    if code["revision"]:
        modified = ", modified" if code["modified"] else ""
        version += f" ({code['revision'][:12]}{modified})"
    return f"{hardware}; {used} (threads: {', '.join(map(str, threads))}); {version}."
