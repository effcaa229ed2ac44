"""``ganlane NAME key=value ...``: the same as ``python -m ganlane.NAME key=value ...``."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Sequence

from ganlane._version import __version__
from ganlane.errors import USER_ERROR
from ganlane.files import conf_folder
from ganlane.runtime import open_closed_streams, status_of

#: Commands with a configuration, and what they do; each is a module of the package with a ``main``.
COMMANDS = {
    "train": "train an agent on a traffic, then compare it with other drivers",
    "evaluate": "agents x traffics on the same episodes, as one table",
    "render": "episodes as a film, page or table; learning curves of runs",
    "record": "a driver's episodes as an offline dataset in Minari's format",
    "prepare": "recordings into one schema, with a report of what they show",
    "train_generator": "fit a generator to recorded traffic",
    "realism": "how close a traffic comes to recorded driving",
    "reproduce": "the paper's tables and figures, and the matrix behind them, in one folder",
}
#: Commands without a configuration: they take no keys.
PLAIN_COMMANDS = {"doctor": "check the installation; show the command for what is missing"}
#: All commands, with and without keys.
ALL_COMMANDS = COMMANDS | PLAIN_COMMANDS
COMPLETION_FLAGS = ("-sc", "--shell-completion")
SHELLS = ("bash", "zsh", "fish")


def usage() -> str:
    """The commands in a few lines."""
    listed = "\n".join(f"  {name:<17}{text}" for name, text in ALL_COMMANDS.items())
    return (
        f"usage: ganlane COMMAND key=value ...\n\n{listed}\n\nganlane COMMAND --help explains its options and keys.\n"
        'eval "$(ganlane -sc install=bash)" completes commands, options and keys in this shell.'
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console script; the exit status."""
    open_closed_streams()
    try:
        status = dispatch(arguments)
        sys.stdout.flush()
        return status
    except OSError as error:
        return status_of(error, "ganlane")


def dispatch(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    command, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if command in ("-h", "--help", "help"):
        print(usage())
        return 0
    if command == "--version":
        print(__version__)
        return 0
    if set(COMPLETION_FLAGS) & {command, *rest}:
        return shell_completion([command, *rest])
    if command not in ALL_COMMANDS:
        print(
            f"ganlane: {command}: no such command; choose one of {', '.join(ALL_COMMANDS)}.",
            file=sys.stderr,
        )
        return USER_ERROR
    return importlib.import_module(f"ganlane.{command}").main(rest)


def shell_completion(arguments: Sequence[str]) -> int:
    """``ganlane [COMMAND] -sc install=SHELL`` and the like; the exit status.

    Hydra completes programs that are a single command: its shell function calls the program,
    ``ganlane``, without the command, which is therefore read from the line and removed before Hydra
    completes the rest.
    """
    asked = next(
        filter(
            None, (re.fullmatch(r"(install|uninstall|query)=(\w+)", each) for each in arguments)
        ),
        None,
    )
    if asked is None or asked[2] not in SHELLS:
        print(
            f'ganlane: {" ".join(arguments)}: expected for instance eval "$(ganlane -sc install=bash)"; shells: '
            f"{', '.join(SHELLS)}.",
            file=sys.stderr,
        )
        return USER_ERROR
    action, shell = asked.groups()
    if action == "query":
        print(("\n" if shell == "fish" else " ").join(candidates(os.environ.get("COMP_LINE", ""))))
    else:
        importlib.import_module("ganlane.config.help").print_completion_script(action, shell)
    return 0


def candidates(line: str) -> list[str]:
    """Completions of the last word of ``line``, as typed so far, the program's name included."""
    parts = re.match(r"\s*\S+(?:\s+(\S*)(\s.*)?)?$", line)
    command, rest = (parts[1] or "", parts[2]) if parts else ("", None)
    if rest is None:
        return [name for name in ALL_COMMANDS if name.startswith(command)]
    if not (conf_folder() / f"{command}.yaml").is_file():
        return []
    # Imported here: completing the name of a command takes half of the time without Hydra.
    return importlib.import_module("ganlane.config.help").completed(command, rest)


if __name__ == "__main__":
    sys.exit(main())
