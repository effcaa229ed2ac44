"""Run folders: their content, their lock, their removal after a user's mistake, and ``resume=...``."""

from __future__ import annotations

import itertools
import os
import shlex
import shutil
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from ganlane.arguments import is_import_path
from ganlane.config.command_line import leaves, of_hydra, parse, quoted, without_repetitions
from ganlane.config.train import TrainConfig
from ganlane.errors import UserError, as_typed
from ganlane.files import remove_leftovers, write_bytes
from ganlane.parameters.agent import without_removed_overrides

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: File in the run folder with the run's command line.
OVERRIDES = "overrides.yaml"
CONFIG = "config.yaml"
#: File that names the process that uses the folder.
LOCK = ".lock"
#: Files that took time to make.
EARNED = ("results.json", "agent.safetensors", "last.pt", "fits/*.pt", "generator_*.safetensors")
#: Folders of a run that it writes to itself; others below it may be runs of their own.
_OWN = (".", "checkpoints", "pretrain", "pretrain/checkpoints", "fits")
_RUNS = Path("outputs")
#: The checkpoint of a run, below its folder.
LAST = Path("checkpoints") / "last.pt"
#: Last parts of the keys that name code to execute: import paths, and a Ray cluster's address.
_IMPORTED_BY = ("_target_", "shares", "agents", "address")
#: Keys whose defaults have changed since version 0.1.0.
CHANGED_SINCE_0_1 = ("total_decisions", "collector.num_envs", "evaluation.episodes")


@contextmanager
def cleared_after_mistakes(folder: Path, existed: bool | None = None) -> Iterator[None]:
    """Context that removes a newly made folder, and newly made folders above it, if a mistake ends
    the run.

    A folder with results, trained weights or a checkpoint is never removed, nor one that another
    process uses.

    Args:
        folder: of the run or the sweep.
        existed: whether it held something before; by default, whether it exists now.
    """
    existed = folder.exists() if existed is None else existed
    made = [parent for parent in folder.parents if not parent.exists()]
    try:
        yield
    except BaseException as error:
        is_mistake = isinstance(error, UserError | OSError)
        if (
            is_mistake
            and not existed
            and not any(any(folder.rglob(name)) for name in (*EARNED, LOCK))
        ):
            shutil.rmtree(folder, ignore_errors=True)
            for parent in made:  # innermost first
                if parent.is_dir() and not any(parent.iterdir()):
                    parent.rmdir()
        raise


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Context that makes and locks a run's folder.

    Partial files of killed writes are removed. A refused run restores the command line of the run
    before it; a run that fails after it has saved something keeps its own, so that it can be
    resumed.

    Raises:
        UserError: another run uses the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        kept = {
            name: (folder / name).read_bytes()
            for name in (OVERRIDES, CONFIG)
            if (folder / name).is_file()
        }
        before = earned(folder)
        try:
            yield
        except (UserError, OSError):
            if earned(folder) == before:
                for name in (OVERRIDES, CONFIG):
                    if name in kept:
                        write_bytes(folder / name, kept[name])
                    else:
                        (folder / name).unlink(missing_ok=True)
            raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the system's lock on a file that names this process; the system releases it when the
    process dies.

    So the file of a killed run blocks nobody, even if its process number is in use again. Without
    locks in the operating or file system, nothing is locked.

    Raises:
        UserError: another run holds the lock.
    """
    path = folder / LOCK
    while True:
        file = path.open("a+", errors="replace")
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            who = file.read().strip() or "another process"
            file.close()
            raise UserError(
                f"{folder}: a run is at work there ({who}); wait for its end, or give another folder."
            ) from error
        except OSError:  # the file system has no locks
            pass
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # the process that held it has just removed the file
    try:
        for part in _OWN:
            remove_leftovers(folder / part)  # first, since they may fill the disk
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


def unused(folder: Path) -> Path:
    """``folder``, or the same name with a number if it holds a run already.

    The name holds time and process, so two runs of a process within a second would share it.
    """
    names = itertools.chain(
        [folder.name], (f"{folder.name}_{number}" for number in itertools.count(2))
    )
    return next(
        folder.with_name(name) for name in names if not (folder.with_name(name) / CONFIG).exists()
    )


def earned(folder: Path) -> set[tuple[Path, int]]:
    """The run's files that took time to make, with the times of their last change."""
    found = [path for part in _OWN for name in EARNED for path in (folder / part).glob(name)]
    return {(path, path.stat().st_mtime_ns) for path in found}


def write_config(composed: Any, overrides: list[str], folder: Path) -> None:
    """Write all values to ``config.yaml`` and the command line to ``overrides.yaml``."""
    write_bytes(folder / CONFIG, OmegaConf.to_yaml(composed, resolve=True).encode())
    write_bytes(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(overrides)).encode())


def stored_command(folder: Path, program: str, without: Sequence[str] = ()) -> str:
    """The command line of the run in ``folder``, ``program`` first, without overrides that start as
    ``without`` says.

    For a run that was started from Python, it says so in place of a command.
    """
    path = folder / OVERRIDES
    if not path.is_file():
        return f"called from Python: ganlane.api.run({program.rpartition('.')[2].rpartition(' ')[2]!r}, ...)"
    overrides = [str(override) for override in OmegaConf.load(path)]
    return f"{program} {shlex.join(each for each in overrides if not each.startswith(tuple(without)))}".rstrip()


# --- resume


def with_resumed(command: str, overrides: Sequence[str], multirun: bool) -> list[str]:
    """The overrides, preceded by those of the resumed run, with its folder as run folder; only
    ``train`` resumes so.

    Raises:
        UserError: there is no such run, or the command line is a sweep (``multirun``).
    """
    given = [override.value() for override in parse(overrides) if override.key_or_group == "resume"]
    if command != "train" or not given or given[-1] in (None, ""):
        return list(overrides)
    asked = str(given[-1])
    if multirun:
        raise UserError(f"resume={asked}: one run is resumed at a time; start without -m.")
    run = newest_unfinished(_RUNS / command) if asked == "auto" else run_folder(Path(asked))
    if run is None:
        print(
            f"resume=auto: no unfinished run below {_RUNS / command}; a new one is started.",
            file=sys.stderr,
        )
        return without_repetitions([*overrides, "resume=null"])
    stored = [*_old_defaults(run), *_stored(run / OVERRIDES)]
    return without_repetitions(
        [*stored, *overrides, f"resume={quoted(run)}", f"hydra.run.dir={quoted(run)}"]
    )


def _old_defaults(run: Path) -> list[str]:
    """Overrides with the old defaults, for a run that was started before train's defaults changed.

    Such a run has no ``compile`` in its config.yaml, from which the numbers and the form of the
    mask are taken.
    """
    try:
        config: Any = OmegaConf.load(run / CONFIG)
        if "compile" in config:
            return []
        kept = {key: OmegaConf.select(config, key) for key in CHANGED_SINCE_0_1}
        mask = OmegaConf.select(config, "mask.form") or "none"
    except Exception:  # missing, or not YAML; reading the checkpoint will report what is wrong
        return []
    numbers = [f"{key}={quoted(value)}" for key, value in kept.items()]
    return [f"mask={mask}", "agent=rainbow", "compile=never", *numbers]


def _stored(path: Path) -> list[str]:
    """The command line of a run.

    Raises:
        UserError: the file is not a list of overrides.
    """
    try:
        found = OmegaConf.to_container(OmegaConf.load(path))
    except Exception:  # a file that is not YAML can raise many errors
        found = None
    if not isinstance(found, list) or not all(isinstance(override, str) for override in found):
        raise UserError(
            f"{path}: damaged, expected a list of key=value; write the run's command line there, or start a new run."
        )
    kept = without_removed_overrides(map(str, found), str(path))
    for override in OverridesParser.create().parse_overrides(kept):
        if of_hydra(override):
            raise UserError(
                f"{path}: {override.input_line}: Hydra is not set by a run's files; remove that line."
            )
    return kept


def refuse_stored_imports(config: TrainConfig, overrides: Sequence[str]) -> None:
    """Refuse code from outside the package that the run's files name, unless ``overrides``, the
    command line, do too.

    Raises:
        UserError: the run's files name a class or function of another package, or a Ray cluster.
    """
    asked = [
        each for each in parse(overrides) if each.key_or_group.rpartition(".")[2] in _IMPORTED_BY
    ]
    named = {name.partition("+")[0] for override in asked for name in leaves(override.value())}
    for key, path in _imports(config):
        if not path.startswith(("ganlane.", "ganlane_simulators.")) and path not in named:
            raise UserError(
                f"resume={config.resume}: the run's files name {path}, and code from there would be executed; if you "
                f"trust it, add {key} to the command line."
            )


def _imports(config: TrainConfig) -> Iterator[tuple[str, str]]:
    """Every import path of a run, and Ray's address, each with the override that names it."""
    address = getattr(config.collector, "address", None)
    if address not in (None, "auto"):  # a cluster sends pickles
        yield f"collector.address={address}", str(address)
    traffics = {"pretrain.traffic": config.pretrain.traffic, "traffic": config.traffic}
    for key, traffic in {**traffics, "evaluation.traffic": config.evaluation.traffic}.items():
        if traffic is not None:
            yield f"{key}._target_={traffic._target_}", traffic._target_
            shares = ",".join(
                f"{name}:{share}" for name, share in getattr(traffic, "shares", {}).items()
            )
            for name, part in traffic.parts().items():
                known = name in getattr(traffic, "options", {})
                yield (
                    f"{key}.options.{name}._target_={part._target_}"
                    if known
                    else f"'{key}.shares={{{shares}}}'",
                    part._target_,
                )
    agents = config.evaluation.agents
    for name in agents:
        path = name.partition("+")[0]
        if is_import_path(path) and not path.endswith(".safetensors") and not Path(path).is_file():
            yield f"evaluation.agents={as_typed(agents)}", path


def run_folder(path: Path) -> Path:
    """The run that ``path`` belongs to: its folder, a phase's folder, or a checkpoint.

    Raises:
        UserError: there is no run.
    """
    if path.is_file() and path.name != "last.pt":
        raise UserError(
            f"resume={path}: a run continues from its last.pt only; give the run's folder."
        )
    for folder in [path, *path.parents[:3]] if path.exists() else []:
        if (folder / OVERRIDES).is_file() and any(folder.rglob("last.pt")):
            return folder
    expected = path / LAST if path.is_dir() else path
    if not expected.is_file():
        raise UserError(
            f"resume={path}: no checkpoint there ({expected}); give a run's folder, its {LAST}, or auto."
        )
    raise UserError(
        f"resume={path}: {OVERRIDES} is missing there; give the folder that the run was written to."
    )


def newest_unfinished(runs: Path) -> Path | None:
    """The run with the newest checkpoint among those without results; None if there is none."""
    checkpoints = sorted(runs.rglob("last.pt"), key=lambda path: path.stat().st_mtime, reverse=True)
    for checkpoint in checkpoints:
        folder = next(
            (parent for parent in checkpoint.parents if (parent / OVERRIDES).is_file()), None
        )
        if folder is not None and not (folder / "results.json").is_file():
            return folder
    return None
