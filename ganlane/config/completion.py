"""Shell completion of ``ganlane COMMAND ...``: names of commands, then Hydra's completion of options and keys.

Hydra completes programs that are a single command: its shell function calls the program, here ``ganlane``, without
the command, which is therefore read from the line and removed before Hydra completes the rest.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Sequence
from importlib import import_module
from types import ModuleType

from ganlane.errors import UserError
from ganlane.files import conf_folder

SHELLS = ("bash", "zsh", "fish")
ACTIONS = ("install", "uninstall", "query")
PROGRAM = "ganlane"


def shell_completion(arguments: Sequence[str], commands: Collection[str]) -> int:
    """``ganlane [COMMAND] -sc install=SHELL`` and the like; the exit status.

    Args:
        arguments: as on the command line, in any order.
        commands: names to complete first.
    """
    try:
        action, shell = _asked(arguments)
    except UserError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 2
    if action == "query":
        found = candidates(os.environ.get("COMP_LINE", ""), commands)
        print(("\n" if shell == "fish" else " ").join(found))
    else:
        _hydra().print_script(action, shell)
    return 0


def _asked(arguments: Sequence[str]) -> tuple[str, str]:
    """The action and the shell."""
    for argument in arguments:
        action, equals, shell = argument.partition("=")
        if equals and action in ACTIONS and shell in SHELLS:
            return action, shell
    example = f'eval "$({PROGRAM} -sc install=bash)"'
    raise UserError(f"{' '.join(arguments)}: expected for instance {example}; shells: {', '.join(SHELLS)}.")


def candidates(line: str, commands: Collection[str]) -> list[str]:
    """Completions of the last word of ``line``.

    Args:
        line: as typed so far, the program's name included.
        commands: names to complete first.
    """
    parts = re.match(r"\s*\S+(?:\s+(\S*)(\s.*)?)?$", line)
    command, rest = (parts[1] or "", parts[2]) if parts else ("", None)
    if rest is None:
        return [name for name in commands if name.startswith(command)]
    if not (conf_folder() / f"{command}.yaml").is_file():
        return []
    return _hydra().completed(command, rest)


def _hydra() -> ModuleType:
    """What needs Hydra, imported here: completing the name of a command takes half of the time without."""
    return import_module("ganlane.config.hydra_completion")
