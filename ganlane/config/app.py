"""Runs a command: Hydra composes and sweeps; errors become one sentence and an exit status.

Exit statuses: 0 done; 2 a user's mistake or a failing disk (one sentence on stderr, nothing left on
disk); 130 stopped by Ctrl-C, 143 by SIGTERM (training saves first); 141 the reader of the output
has closed it.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from hydra.core.hydra_config import HydraConfig

from ganlane.config.command_line import (
    CONFIG_ERRORS,
    VERSION_BASE,
    check,
    of_hydra,
    parse,
    parse_arguments,
    quoted,
    sentence,
    typed,
    with_shares_replaced,
    without_repetitions,
)
from ganlane.config.help import help_text
from ganlane.config.runs import (
    cleared_after_mistakes,
    held,
    refuse_stored_imports,
    unused,
    with_resumed,
    write_config,
)
from ganlane.config.schemas import register
from ganlane.errors import USER_ERROR, UserError, numbered_refusals
from ganlane.files import conf_folder
from ganlane.runtime import (
    check_process,
    keep_freed_memory,
    open_closed_streams,
    register_envs,
    status_of,
)

#: A command's function of config and run folder; it returns the last line to print, or None.
Task = Callable[[Any, Path], str | None]
#: Modules of the commands' functions, each named as its command, that are not in
#: :mod:`ganlane.commands`.
_ELSEWHERE = {"evaluate": "ganlane.compare"}


def function_of(command: str) -> Callable[[Any, Path], str]:
    """The command's function; importing its module imports torch, which takes seconds."""
    return getattr(
        importlib.import_module(_ELSEWHERE.get(command, f"ganlane.commands.{command}")), command
    )


class Stopped(BaseException):
    """Raised when a signal ended the command after an orderly stop.

    The exit status is 128 plus its number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Job(NamedTuple):
    """A run that is checked and about to begin.

    Attributes:
        config: of the command.
        folder: of the run.
        composed: the same as Hydra composed it, for the folder.
        overrides: the command line, for the folder.
    """

    config: Any
    folder: Path
    composed: Any
    overrides: list[str]


def run_command(
    command: str, arguments: Sequence[str] | None = None, task: Task | None = None
) -> int:
    """Run ``ganlane COMMAND`` with command-line ``arguments`` (None: the process's); the exit
    status.

    A ``task`` takes the place of the command's function.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    open_closed_streams()
    # TorchRL would log every replay buffer.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    keep_freed_memory()
    try:
        with _sigterm_as_exception():
            job = _checked(command, task, arguments)
            if job is not None:
                with cleared_after_mistakes(job.folder), _in_folder(job):
                    last_line = (task or function_of(command))(job.config, job.folder)
                if last_line:
                    print(last_line)
            sys.stdout.flush()
    except BaseException as error:
        number = _signal_behind(error)
        if number == signal.SIGINT:
            print(f"ganlane {command}: stopped by Ctrl-C.", file=sys.stderr)
        if number is not None:
            return 128 + number
        if isinstance(error, (UserError, *CONFIG_ERRORS)):
            print(f"ganlane {command}: {sentence(error)}", file=sys.stderr)
            return USER_ERROR
        if isinstance(error, OSError):
            return status_of(error, f"ganlane {command}")
        raise
    return 0


def _signal_behind(error: BaseException | None) -> int | None:
    """The signal behind ``error``, or None.

    Omegaconf, when interrupted, raises an error of its own from it.
    """
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return signal.SIGINT
        if isinstance(error, Stopped):
            return error.number
        error = error.__cause__ or error.__context__
    return None


def _checked(command: str, task: Task | None, arguments: list[str]) -> Job | None:
    """The run that ``arguments`` ask for.

    None if they ask for something else, such as help or a sweep, done here.
    """
    flags = parse_arguments(command, arguments)
    if flags.help or flags.help_all:
        print(help_text(command, flags.help_all))
        return None
    check_process()
    parse(flags.overrides)
    if flags.cfg or flags.info or flags.shell_completion or flags.hydra_help:
        as_given = parse_arguments("", arguments).overrides
        hydras = dict(zip(as_given, flags.overrides))
        _hydra(command, task, [hydras.get(argument, argument) for argument in arguments])
        return None
    overrides = with_resumed(command, flags.overrides, flags.multirun)
    checked = check(command, overrides, flags.multirun)
    if command == "train" and checked.config.resume is not None:
        refuse_stored_imports(checked.config, flags.overrides)
    if flags.multirun:
        folder = checked.sweep_folder.absolute()
        with cleared_after_mistakes(folder):
            # The default name holds the time; passed on, so that Hydra uses the folder that was
            # checked.
            swept = without_repetitions([*overrides, f"hydra.sweep.dir={quoted(folder)}"])
            _hydra(command, task, ["-m", *with_shares_replaced(swept)])
            _show_sweep(folder, checked.config.columns)
        return None
    folder = checked.run_folder.absolute()
    if not any(each.startswith("hydra.run.dir=") for each in overrides):
        folder = unused(folder)
    given = parse(without_repetitions(overrides))
    kept = [str(override.input_line) for override in given if not of_hydra(override)]
    return Job(checked.config, folder, checked.composed, kept)


def _show_sweep(folder: Path, columns: str) -> None:
    """One table of all comparisons of a sweep."""
    # Imported here, since they import torch, which takes seconds.
    from ganlane.evaluation.results import sweep_rows
    from ganlane.evaluation.table import show, text_table

    rows = sweep_rows(folder)
    if rows:
        show("", text_table(rows), f"sweep: {folder}", columns=columns)


@contextmanager
def _in_folder(job: Job) -> Iterator[None]:
    """Hold the run folder, with the configuration written into it."""
    # for a user's own driver or traffic; ganlane/__init__.py leaves it to the commands
    register_envs()
    with held(job.folder):
        write_config(job.composed, job.overrides, job.folder)
        with numbered_refusals():
            yield


def _hydra(command: str, task: Task | None, arguments: list[str]) -> None:
    """Let Hydra print the configuration or run a sweep; errors are raised unchanged."""
    register(command)
    mistakes: list[Exception] = []
    here = os.getpid()

    def run(composed: Any) -> None:
        folder = Path(HydraConfig.get().runtime.output_dir)
        overrides = [str(override) for override in HydraConfig.get().overrides.task]
        try:
            with cleared_after_mistakes(folder, existed=any(folder.iterdir())):
                job = Job(typed(composed), folder, composed, overrides)
                with _in_folder(job):
                    last_line = (task or function_of(command))(job.config, folder)
            if last_line:
                print(last_line, flush=True)
        except (UserError, OSError) as error:
            # Kept rather than raised, because Hydra would print it too; a worker process must
            # raise.
            mistakes.append(error)
            if os.getpid() != here:
                raise

    application = hydra.main(
        version_base=VERSION_BASE, config_path=str(conf_folder()), config_name=command
    )(run)
    with _process([f"ganlane {command}", *arguments]):
        application()
    if mistakes:
        raise mistakes[0]


@contextmanager
def _process(argv: list[str]) -> Iterator[None]:
    """Set ``sys.argv`` for Hydra, and make it raise errors rather than print them and exit with
    status 1.
    """
    before, full = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv, os.environ["HYDRA_FULL_ERROR"] = argv, "1"
    try:
        yield
    except SystemExit as end:
        if end.code not in (0, None):
            raise UserError(
                f"Hydra stopped with status {end.code}; run with --help to see what it takes."
            ) from end
    finally:
        sys.argv = before
        if full is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full


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
