"""Runs a command: from words to a checked record, a run folder, a result and an exit status.

Exit statuses: 0 done; 2 a user's mistake or a failing disk (one sentence on stderr, nothing left on
disk); 130 stopped by Ctrl-C, 143 by SIGTERM (training saves first); 141 the reader of the output
has closed it.
"""

from __future__ import annotations

import importlib
import itertools
import os
import shutil
import signal
import socket
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from ganlane.arguments import is_function_path, is_import_path
from ganlane.config.compose import (
    ALIASES,
    VERSION_BASE,
    called,
    composed,
    for_hydra,
    key_of,
    parsed,
    resumed,
)
from ganlane.config.help import help_text
from ganlane.errors import USER_ERROR, UserError, as_typed, numbered_refusals
from ganlane.files import conf_folder, remove_leftovers, write_bytes
from ganlane.runtime import (
    check_process,
    keep_freed_memory,
    open_closed_streams,
    register_envs,
    status_of,
)
from ganlane.settings.commands import EvaluateConfig, RecordConfig, with_env_keys
from ganlane.settings.record import Record, make, merged, plain, saved_config
from ganlane.settings.recordings import PrepareConfig, RealismConfig, TrainGeneratorConfig
from ganlane.settings.render import RenderConfig
from ganlane.settings.suite import BenchmarkConfig
from ganlane.settings.train import TrainConfig

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: A command's settings. The module of its name in :mod:`ganlane.commands` has a function of its
#: name, which takes settings and run folder and returns the line that names its results.
COMMANDS: dict[str, type[Record]] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "benchmark": BenchmarkConfig,
    "render": RenderConfig,
    "record": RecordConfig,
    "prepare": PrepareConfig,
    "train_generator": TrainGeneratorConfig,
    "realism": RealismConfig,
}
#: File in the run folder with all settings; what a run is resumed from.
CONFIG = "config.yaml"
#: File that names the process that uses the folder.
LOCK = ".lock"
#: The checkpoint of a run, below its folder.
LAST = Path("checkpoints") / "last.pt"
#: Files that took time to make.
EARNED = (
    "results.json",
    "agent.safetensors",
    "last.pt",
    "fits/*.pt",
    "generator_*.safetensors",
)
#: Where runs go that are given no folder.
OUTPUTS = Path("outputs")
#: Folders of a run that it writes to itself; others below it may be runs of their own.
_OWN_FOLDERS = (
    ".",
    "checkpoints",
    "pretrain",
    "pretrain/checkpoints",
    "fits",
)
#: Import paths below these are trusted wherever they stand.
_OWN_PACKAGES = ("ganlane.", "ganlane_simulators.")


# A BaseException, so that no `except Exception` on the way holds the process back.
class Stopped(BaseException):
    """A signal ended the command after an orderly stop; the exit status is 128 plus its number."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


# --- the command line


def run_command(command: str, arguments: Sequence[str] | None = None) -> int:
    """``ganlane COMMAND key=value ...`` (None: the process's arguments); the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Before anything is opened: a file would get the number of a closed stream.
    open_closed_streams()
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL would log every replay buffer
    keep_freed_memory()

    try:
        with _sigterm_as_exception():
            _do(command, words)
            # Here, so that a reader who has left is noticed while it can still be reported.
            sys.stdout.flush()
    except UserError as error:
        line = " ".join(str(error).split()).rstrip(".")
        print(f"ganlane {command}: {line}.", file=sys.stderr)
        return USER_ERROR
    except OSError as error:
        return status_of(error, f"ganlane {command}")
    except (KeyboardInterrupt, Stopped) as stop:
        if isinstance(stop, Stopped):
            return 128 + stop.number
        print(f"ganlane {command}: stopped by Ctrl-C.", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0


def _run(command: str, config: Any, folder: Path) -> None:
    """Do what a command does, and print the line that names its results."""
    with running(folder, config):
        line = function_of(command)(config, folder)
    print(line, flush=True)


def _do(command: str, words: list[str]) -> None:
    """What the words ask for: help, the configuration, a sweep, or a run.

    Raises:
        UserError: a flag that there is not, or a mistake in the settings.
    """
    # Hydra would have a score of flags; these three are all that is needed.
    flags = [word for word in words if word.startswith("-")]
    keys = [word for word in words if word not in flags]

    if {"-h", "--help"} & set(flags):
        print(help_text(command, COMMANDS[command]))
    elif flags == ["--cfg"] and "job" in keys:
        keys.remove("job")
        print(as_yaml(settings(command, keys)), end="")
    elif set(flags) <= {"-m", "--multirun"}:
        check_process()
        overrides = parsed(command, keys)
        if flags:
            _sweep(command, overrides)
        else:
            config, folder = _settings_and_folder(command, overrides)
            _run(command, config, folder.absolute())
    else:
        unknown = next(flag for flag in flags if flag not in ("-m", "--multirun"))
        raise UserError(f"{unknown}: no such flag; run the command with --help to see them.")


def settings(command: str, words: Sequence[str]) -> Any:
    """The checked record of a command line.

    Raises:
        UserError: an unknown key or option, a value of the wrong type or out of range.
    """
    return _settings_and_folder(command, parsed(command, words))[0]


def _settings_and_folder(command: str, overrides: list[Override]) -> tuple[Any, Path]:
    """The checked record, and the folder of its run: the resumed one, that given, or a new one."""
    # The last word of a key counts.
    values = {str(word.key_or_group): word for word in overrides}
    rest = overrides
    # A resumed training is its saved settings; the command line changes some of them. For
    # train_generator resume= is a key like any other.
    resume = None
    if command == "train":
        resume = values.pop("resume", None)
        rest = [word for word in overrides if word.key_or_group != "resume"]
    if resume is not None and resume.value() not in (None, ""):
        folder = _resumed_folder(str(resume.value()))
        if folder is not None:
            data = resumed(saved_config(folder / CONFIG), rest)
            config: Any = make(TrainConfig, {**data, "resume": str(folder)})
            refuse_stored_imports(config, map(key_of, rest))
            return config, folder

    config = make(COMMANDS[command], composed(command, rest))
    where = values.get("hydra.run.dir")
    if where is None:
        return config, new_folder(command)
    return config, Path(str(where.value()))


def new_folder(command: str) -> Path:
    """A folder below ``outputs/`` that is not there yet, named by time and process."""
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{os.getpid()}"
    folder = OUTPUTS / command / name
    numbers = itertools.count(2)
    while folder.exists():  # two runs of a process within a second
        folder = folder.with_name(f"{name}_{next(numbers)}")
    return folder


def call_settings(command: str, keys: Mapping[str, Any]) -> Any:
    """The checked record of a Python call; what is no key of the command is one of its ``env``.

    Raises:
        UserError: an unknown key or option, a value of the wrong type or out of range.
    """
    kind = COMMANDS[command]
    aliases = ALIASES.get(command, {})
    keys = {aliases.get(name, name): value for name, value in keys.items()}
    keys = with_env_keys(kind, keys)
    if command == "train" and keys.get("resume") is not None:
        saved = saved_config(Path(keys["resume"]) / CONFIG)
        config: Any = make(kind, merged(saved, keys))
        refuse_stored_imports(config, _whole_keys(keys))
        return config
    return make(kind, called(command, keys))


# --- sweeps


def _sweep(command: str, overrides: list[Override]) -> None:
    """All combinations, each in its own folder, by Hydra's launcher; all are checked before.

    Raises:
        UserError: a mistake in any combination, or a run is to be resumed.
        OSError: a file or disk failed in one of the runs.
    """
    if any(word.key_or_group == "resume" for word in overrides):
        raise UserError("resume: one run is resumed at a time; start without -m.")
    checked = [settings(command, words) for words in single_runs(overrides)]

    # Every combination was checked above, so what fails now is a file or a disk.
    mistakes: list[Exception] = []
    # The launcher may run jobs in processes of their own, whose lists this one does not see.
    here = os.getpid()
    sweep_folder: list[Path] = []

    def job(_: Any) -> None:
        """One combination, which Hydra has put into its own configuration."""
        state = HydraConfig.get()
        sweep_folder[:] = [Path(state.sweep.dir)]
        # Without the ++ that for_hydra has put before the key.
        words = [str(word).lstrip("+") for word in state.overrides.task]
        try:
            _run(command, settings(command, words), Path(state.runtime.output_dir))
        except (UserError, OSError) as error:
            # Hydra would print it too; a worker process must raise.
            mistakes.append(error)
            if os.getpid() != here:
                raise

    # Hydra's launchers (joblib, submitit, ray) run the jobs; it reads its arguments from sys.argv.
    application = hydra.main(
        version_base=VERSION_BASE,
        config_path=str(conf_folder()),
        config_name=command,
    )
    OmegaConf.register_new_resolver("process_id", os.getpid, replace=True)
    before = sys.argv
    full = os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [f"ganlane {command}", "-m", *for_hydra(overrides)]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # raise, rather than print and exit with status 1
    try:
        application(job)()
    finally:
        sys.argv = before
        if full is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full
    if mistakes:
        raise mistakes[0]
    if not sweep_folder:
        return

    # Imported here, since they import torch, which takes seconds.
    from ganlane.evaluation.results import sweep_rows
    from ganlane.evaluation.table import show, text_table

    # One table of all comparisons.
    rows = sweep_rows(sweep_folder[0])
    if rows:
        line = f"sweep: {sweep_folder[0].absolute()}"
        show("", text_table(rows), line, columns=checked[0].columns)


def single_runs(overrides: Sequence[Override]) -> list[list[str]]:
    """The words of every run of a sweep: all combinations."""
    # Of every key its words: one, or all that are swept over.
    choices: list[list[str]] = []
    for override in overrides:
        if str(override.key_or_group).startswith("hydra"):
            continue
        words = [str(override.input_line)]
        if override.is_sweep_override():
            key = override.get_key_element()
            words = [f"{key}={value}" for value in override.sweep_string_iterator()]
        choices.append(words)
    return [list(words) for words in itertools.product(*choices)]


# --- a run and its folder


def as_yaml(config: Record) -> str:
    """All keys and values of a record."""
    return yaml.safe_dump(plain(config), sort_keys=False, allow_unicode=True)


@contextmanager
def running(folder: Path, config: Any) -> Iterator[None]:
    """What holds for the time of a run: its folder is locked, the settings in it, threads are set.

    Raises:
        UserError: another run uses the folder.
    """
    register_envs()  # for a user's own driver or traffic
    with cleared_after_mistakes(folder), held(folder):
        write_bytes(folder / CONFIG, as_yaml(config).encode())
        from ganlane.torch_settings import torch_threads  # torch takes seconds

        with numbered_refusals(), torch_threads(config.threads):
            yield


def function_of(command: str) -> Callable[[Any, Path], str]:
    """The command's function; importing its module imports torch, which takes seconds."""
    return getattr(importlib.import_module(f"ganlane.commands.{command}"), command)


@contextmanager
def cleared_after_mistakes(folder: Path) -> Iterator[None]:
    """Remove a newly made folder, and newly made folders above it, if a mistake ends the run.

    A folder with results, trained weights or a checkpoint is never removed, nor one that another
    process uses.
    """
    # A folder with something in it is the user's; only what this run made may go.
    existed = folder.is_dir() and any(folder.iterdir())
    # Noted before the folder is made, which makes its parents as well.
    new_parents = [parent for parent in folder.parents if not parent.exists()]
    try:
        yield
    except (UserError, OSError):
        # The lock is there while another process is at work.
        precious = (*EARNED, LOCK)
        if not existed and not any(any(folder.rglob(name)) for name in precious):
            shutil.rmtree(folder, ignore_errors=True)
            for parent in new_parents:  # innermost first
                if parent.is_dir() and not any(parent.iterdir()):
                    parent.rmdir()
        raise


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Make and lock a run's folder; a refused run leaves the settings of the run before it.

    Raises:
        UserError: another run uses the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        path = folder / CONFIG
        settings_before = path.read_bytes() if path.is_file() else None
        earned_before = earned(folder)
        try:
            yield
        except (UserError, OSError):
            # A run that fails after it has saved something keeps its own, so it can be resumed.
            if earned(folder) == earned_before:
                if settings_before is None:
                    path.unlink(missing_ok=True)
                else:
                    write_bytes(path, settings_before)
            raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the system's lock on a file that names this process.

    The system releases it when the process dies, so the file of a killed run blocks nobody. Without
    locks in the operating or file system, nothing is locked.
    """
    path = folder / LOCK
    while True:
        file = path.open("a+", errors="replace")
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            owner = file.read().strip() or "another process"
            file.close()
            raise UserError(
                f"{folder}: a run is at work there ({owner}); wait for its end, or give another "
                "folder."
            ) from error
        except OSError:  # the file system has no locks
            pass
        # The file may have been removed before it was locked; such a lock protects nothing.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # the process that held it has just removed the file

    try:
        for part in _OWN_FOLDERS:
            remove_leftovers(folder / part)  # first, since they may fill the disk
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


def earned(folder: Path) -> set[tuple[Path, int]]:
    """The run's files that took time to make, with the times of their last change."""
    patterns = [f"{part}/{name}" for part in _OWN_FOLDERS for name in EARNED]
    files = [path for pattern in patterns for path in folder.glob(pattern)]
    return {(path, path.stat().st_mtime_ns) for path in files}


# --- resume


def _resumed_folder(asked: str) -> Path | None:
    """The folder of the run to go on with; None: ``auto`` finds none.

    Raises:
        UserError: no run there.
    """
    if asked == "auto":
        folder = newest_unfinished(OUTPUTS / "train")
        if folder is None:
            print(
                f"resume=auto: no unfinished run below {OUTPUTS / 'train'}; a new one is started.",
                file=sys.stderr,
            )
        return folder

    path = Path(asked)
    if path.is_file() and path.name != LAST.name:
        raise UserError(
            f"resume={path}: a run continues from its {LAST.name} only; give the run's folder."
        )
    if path.exists():
        # From a checkpoint upwards: its folder, perhaps that of the first phase, the run.
        for folder in (path, *path.parents[:3]):
            if (folder / CONFIG).is_file() and any(folder.rglob(LAST.name)):
                return folder
    raise UserError(
        f"resume={path}: no checkpoint there ({path / LAST}); give a run's folder, its {LAST}, or "
        "auto."
    )


def newest_unfinished(runs: Path) -> Path | None:
    """The run with the newest checkpoint among those without results; None if there is none."""
    # The newest checkpoint first.
    checkpoints = sorted(runs.rglob(LAST.name), key=lambda path: -path.stat().st_mtime)
    for checkpoint in checkpoints:
        # A run's folder is the nearest one above with settings.
        folder = next((path for path in checkpoint.parents if (path / CONFIG).is_file()), None)
        if folder is not None and not (folder / "results.json").is_file():
            return folder
    return None


def refuse_stored_imports(config: TrainConfig, named: Iterable[str]) -> None:
    """Refuse code from outside the package that a run's file names, unless the user names it too.

    Args:
        config: of the run, as it would go on.
        named: the whole keys that stand on the command line or in the call.

    Raises:
        UserError: the file names a class or function of another package.
    """
    # Naming the code is the user's word that it may run; traffic=my.module.MyTraffic names all keys
    # below it.
    asked = tuple(f"{name}." for name in named)
    for key, value, path in _imports(config):
        # With a dot at the end, so that no key is taken for the beginning of another one.
        is_asked = f"{key}.".startswith(asked)
        if not is_asked and not path.startswith(_OWN_PACKAGES):
            raise UserError(
                f"resume={config.resume}: the run's file names {path}, and code from there would "
                f"be executed; if you trust it, add {key}={value} to the command line."
            )


def _imports(config: TrainConfig) -> Iterator[tuple[str, str, str]]:
    """Every import path of a run, after the key that names it and the value of that key."""
    traffics = {
        "pretrain.traffic": config.pretrain.traffic,
        "traffic": config.traffic,
        "evaluation.traffic": config.evaluation.traffic,
    }
    for key, traffic in traffics.items():
        if traffic is None:
            continue
        yield f"{key}._target_", traffic._target_, traffic._target_
        for name, part in traffic.parts().items():
            if name in getattr(traffic, "options", {}):
                yield f"{key}.options.{name}._target_", part._target_, part._target_
            else:
                yield f"{key}.shares", f"{{{name}: ...}}", part._target_

    agents = config.evaluation.agents
    for name in agents:
        path = name.partition("+")[0]
        # weights, which execute nothing, may have a name of this form
        is_code = is_import_path(path) or is_function_path(path)
        if is_code and not path.endswith(".safetensors") and not Path(path).is_file():
            yield "evaluation.agents", as_typed(agents), path


def _whole_keys(data: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """The keys of a call, down to the values; an option by its ``name`` is one value."""
    for name, value in data.items():
        if isinstance(value, Mapping) and "name" not in value:
            yield from _whole_keys(value, f"{above}{name}.")
        else:
            yield f"{above}{name}"


@contextmanager
def _sigterm_as_exception() -> Iterator[None]:
    """Raise :class:`Stopped` on SIGTERM; the training loop has its own handler."""

    def stop(number: int, frame: Any) -> None:
        raise Stopped(number)

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread, where Python allows no handlers
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
