"""``ganlane COMMAND key=value ...``, the same as ``python -m ganlane COMMAND key=value ...``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from ganlane._version import __version__
from ganlane.errors import USER_ERROR
from ganlane.runtime import open_closed_streams, status_of

#: Commands with keys, and what they do.
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
#: All commands; ``doctor`` takes no keys.
ALL_COMMANDS = COMMANDS | {"doctor": "check the installation; show the command for what is missing"}


def usage() -> str:
    """The commands in a few lines."""
    listed = "\n".join(f"  {name:<17}{text}" for name, text in ALL_COMMANDS.items())
    return (
        f"usage: ganlane COMMAND key=value ...\n\n{listed}\n\n"
        "ganlane COMMAND --help explains its options and keys."
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
    if command not in ALL_COMMANDS:
        print(
            f"ganlane: {command}: no such command; choose one of {', '.join(ALL_COMMANDS)}.",
            file=sys.stderr,
        )
        return USER_ERROR
    # Imported here: composing takes a third of a second, the list of commands none.
    if command == "doctor":
        return importlib.import_module("ganlane.doctor").main(rest)
    return importlib.import_module("ganlane.config.run").run_command(command, rest)


if __name__ == "__main__":
    sys.exit(main())
