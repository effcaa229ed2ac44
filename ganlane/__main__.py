"""``ganlane NAME key=value ...``: the same as ``python -m ganlane.NAME key=value ...``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from ganlane._version import __version__
from ganlane.runtime import open_closed_streams

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
    "bench": "speed and memory, compared with a peer in the same run",
}
#: Commands without a configuration: they take no keys.
PLAIN_COMMANDS = {"doctor": "check the installation; show the command for what is missing"}
COMPLETION_FLAGS = ("-sc", "--shell-completion")


def usage() -> str:
    """The commands in a few lines."""
    listed = "\n".join(f"  {name:<17}{text}" for name, text in (COMMANDS | PLAIN_COMMANDS).items())
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
        return _output_refused(error)


def _output_refused(error: OSError) -> int:
    """The exit status if standard output cannot be written, as in :func:`ganlane.config.app.run_command`."""
    from ganlane.config.app import READER_LEFT, USER_ERROR, discard_broken_streams
    from ganlane.config.messages import file_sentence, is_users_matter

    if discard_broken_streams() and isinstance(error, BrokenPipeError):
        return READER_LEFT
    if not is_users_matter(error):
        raise error
    print(f"ganlane: {file_sentence(error)}", file=sys.stderr)
    return USER_ERROR


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
        from ganlane.config.completion import shell_completion

        return shell_completion([command, *rest], {**COMMANDS, **PLAIN_COMMANDS})
    if command not in COMMANDS | PLAIN_COMMANDS:
        known = ", ".join(COMMANDS | PLAIN_COMMANDS)
        print(f"ganlane: {command}: no such command; choose one of {known}.", file=sys.stderr)
        return 2
    return importlib.import_module(f"ganlane.{command}").main(rest)


if __name__ == "__main__":
    sys.exit(main())
