"""``ganlane COMMAND key=value ...``, the same as ``python -m ganlane COMMAND key=value ...``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from ganlane._version import __version__
from ganlane.errors import USER_ERROR, printable
from ganlane.files import conf_folder
from ganlane.runtime import open_closed_streams, status_of

#: ``doctor`` takes no keys; every other command has a YAML file with its defaults.
DOCTOR = "check the installation"


def commands() -> dict[str, str]:
    """Every command with what it does, from the first line of its YAML file.

    That line is ``# ganlane COMMAND: what it does.``; other files in the folder have none.
    """
    texts = {}
    for path in sorted(conf_folder().glob("*.yaml")):
        first = path.read_text(encoding="utf-8").partition("\n")[0]
        if first.startswith("# ganlane "):
            texts[path.stem] = first.partition(": ")[2].rstrip(".")
    return {**texts, "doctor": DOCTOR}


def usage() -> str:
    """The commands in a few lines."""
    listed = "\n".join(f"  {name:<17}{text}" for name, text in commands().items())
    return (
        f"usage: ganlane COMMAND key=value ...\n\n{listed}\n\n"
        "ganlane COMMAND --help explains its options and keys."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console script; the exit status."""
    open_closed_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    command, *rest = words or ["--help"]
    status = 0
    try:
        if command in ("-h", "--help", "help"):
            print(usage())
        elif command == "--version":
            print(__version__)
        elif command == "doctor":
            status = importlib.import_module("ganlane.doctor").main(rest)
        elif command in commands():
            # Imported here: composing takes a third of a second, the list of commands none.
            return importlib.import_module("ganlane.config.run").run_command(command, rest)
        else:
            names = ", ".join(commands())
            line = f"ganlane: {command}: no such command; choose one of {names}."
            print(printable(line), file=sys.stderr)
            return USER_ERROR
        # Here, so that a reader who has left is noticed while it can still be reported.
        sys.stdout.flush()
    except OSError as error:
        return status_of(error, "ganlane")
    return status


if __name__ == "__main__":
    sys.exit(main())
