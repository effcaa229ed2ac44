"""The frame around every command: Hydra inside, exit statuses and one-sentence errors outside.

Exit statuses: 0 done, 2 a user's mistake (one sentence on stderr, nothing left on disk), 130 stopped by Ctrl-C,
143 by SIGTERM (training saves first).
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ganlane.config.compose import VERSION_BASE, Checked, check, typed
from ganlane.config.help import print_help
from ganlane.config.messages import CONFIG_ERRORS, as_user_error
from ganlane.config.overrides import parse_arguments, without_repetitions
from ganlane.config.resume import OVERRIDES, with_resumed
from ganlane.errors import UserError
from ganlane.files import write_bytes
from ganlane.paths import conf_folder

#: What a command does with its config in its run folder; it returns a line to print last, or None.
Task = Callable[[Any, Path], str | None]

USER_ERROR, INTERRUPTED, TERMINATED = 2, 130, 143


class Stopped(BaseException):
    """A signal ended the command after it had put its things in order."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def run_command(command: str, task: Task, arguments: Sequence[str] | None = None) -> int:
    """Run ``task`` as ``ganlane COMMAND`` with command-line ``arguments`` (None: the process's); the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _sigterm_as_exception():
            _run(command, task, arguments)
    except UserError as error:
        print(f"ganlane {command}: {' '.join(str(error).split())}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print(f"ganlane {command}: stopped by Ctrl-C.", file=sys.stderr)
        return INTERRUPTED
    except Stopped as stop:
        return 128 + stop.number
    return 0


def _run(command: str, task: Task, arguments: list[str]) -> None:
    flags = parse_arguments(arguments)
    if flags.help:
        print_help(command)
        return
    if flags.cfg or flags.info or flags.shell_completion or flags.hydra_help:
        _hydra(command, task, arguments)
        return
    overrides = with_resumed(command, flags)
    checked = check(command, overrides, flags.multirun)
    folder = checked.sweep_folder if flags.multirun else checked.run_folder
    mode = "sweep" if flags.multirun else "run"
    # The folder's name holds the time: given here, so that it is the one that was looked at.
    overrides = without_repetitions([*overrides, f"hydra.{mode}.dir='{folder}'"])
    options = [argument for argument in arguments if argument not in flags.overrides]
    with _cleared_after_mistakes(folder):
        _hydra(command, task, [*options, *overrides])


@contextmanager
def _cleared_after_mistakes(folder: Path) -> Iterator[None]:
    """Remove what a user's mistake leaves of a folder that was not there before."""
    existed = folder.exists()
    try:
        yield
    except UserError:
        if not existed and not any(folder.rglob("results.json")):
            shutil.rmtree(folder, ignore_errors=True)
            _remove_if_empty(folder.parent)
        raise


def _remove_if_empty(folder: Path) -> None:
    """Remove the command's folder below outputs/, if this run was to be the first in it."""
    if folder.is_dir() and folder.parent.name == "outputs" and not any(folder.iterdir()):
        folder.rmdir()


def _hydra(command: str, task: Task, arguments: list[str]) -> None:
    """Let Hydra compose, make the folder and launch, without its own way of reporting errors."""
    import hydra

    def job(composed: Any) -> None:
        config, folder = typed(composed), Path(hydra.core.hydra_config.HydraConfig.get().runtime.output_dir)
        _write_down(composed, folder)
        last_line = task(config, folder)
        if last_line:
            print(last_line, flush=True)

    application = hydra.main(version_base=VERSION_BASE, config_path=str(conf_folder()), config_name=command)(job)
    with _process(["ganlane " + command, *arguments]):
        try:
            application()
        except CONFIG_ERRORS as error:
            raise as_user_error(error) from error
        except SystemExit as end:
            if end.code not in (0, None):
                raise UserError(
                    f"Hydra stopped with status {end.code}; run with --help to see what it takes."
                ) from end


def _write_down(composed: Any, folder: Path) -> None:
    """What was asked for, in the run folder: all values in config.yaml, the command line in overrides.yaml."""
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    asked = [str(override) for override in HydraConfig.get().overrides.task]
    write_bytes(folder / "config.yaml", OmegaConf.to_yaml(composed, resolve=True).encode())
    write_bytes(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(asked)).encode())


@contextmanager
def _process(argv: list[str]) -> Iterator[None]:
    """Arguments where Hydra looks for them, and errors raised rather than printed with status 1."""
    before, full = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv, os.environ["HYDRA_FULL_ERROR"] = argv, "1"
    try:
        yield
    finally:
        sys.argv = before
        os.environ.pop("HYDRA_FULL_ERROR") if full is None else os.environ.update(HYDRA_FULL_ERROR=full)


@contextmanager
def _sigterm_as_exception() -> Iterator[None]:
    """Outside the training loop, which has a handler of its own, SIGTERM unwinds the stack and cleans up."""

    def stop(number: int, frame: Any) -> None:
        raise Stopped(number)

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread: no handlers there
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


__all__ = ["Checked", "Stopped", "run_command"]
