"""``ganlane NAME key=value ...``: the same as ``python -m ganlane.NAME key=value ...``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

#: Command to what it does; each is a module of the package with a ``main``.
COMMANDS = {
    "train": "train an agent on a traffic, then evaluate it beside others",
    "evaluate": "agents x traffics on the same episodes, as one table",
    "render": "an episode of an agent on a traffic as a film",
    "prepare": "recordings into one schema, with a report of what they show",
    "train_generator": "fit a generator to recorded traffic",
    "realism": "how close a traffic comes to recorded driving",
    "bench": "speed and memory, beside a peer measured in the same run",
}


def usage() -> str:
    """The commands in a few lines."""
    listed = "\n".join(f"  {name:<17}{text}" for name, text in COMMANDS.items())
    return (
        f"usage: ganlane COMMAND key=value ...\n\n{listed}\n\nganlane COMMAND --help explains its options and keys."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console script; the exit status."""
    command, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if command in ("-h", "--help", "help"):
        print(usage())
        return 0
    if command == "--version":
        from ganlane import __version__

        print(__version__)
        return 0
    if command not in COMMANDS:
        print(f"ganlane: {command}: no such command; choose one of {', '.join(COMMANDS)}.", file=sys.stderr)
        return 2
    # A console script, unlike python -m, does not look for a user's own modules where it is started.
    if "" not in sys.path:
        sys.path.insert(0, "")
    return importlib.import_module(f"ganlane.{command}").main(rest)


if __name__ == "__main__":
    sys.exit(main())
