"""Shell completion of ``ganlane COMMAND ...``: names of commands, then Hydra's completion of options and keys.

Hydra completes programs that are a single command: its shell function calls the program, here ``ganlane``, without
the command, which is therefore read from the line and removed before Hydra completes the rest.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Sequence

from ganlane.errors import UserError
from ganlane.files import conf_folder

SHELLS = ("bash", "zsh", "fish")
ACTIONS = ("install", "uninstall", "query")
PROGRAM = "ganlane"
#: Any command serves to print the script of a shell.
_ANY = "train"
#: Missing in Hydra's scripts: zsh needs bashcompinit, and bash must forget the removed function.
_BEFORE = {
    ("install", "zsh"): "(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }\n"
    "autoload -Uz bashcompinit && bashcompinit",
    ("uninstall", "bash"): f"complete -r {PROGRAM} 2> /dev/null",
    ("uninstall", "zsh"): f"complete -r {PROGRAM} 2> /dev/null",
}


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
        _script(action, shell)
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
    return _completed(command, rest)


def _completed(command: str, rest: str) -> list[str]:
    """Hydra's completions for one command, without the names of schemas."""
    # Imported here, as in _script: completing the name of a command then takes half of the time.
    from hydra import initialize_config_dir
    from hydra._internal.core_plugins.bash_completion import BashCompletion
    from hydra.core.global_hydra import GlobalHydra

    from ganlane.config.command_line import VERSION_BASE
    from ganlane.config.schemas import SUFFIX, register

    register(command)
    with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE, job_name=command):
        plugin = BashCompletion(GlobalHydra.instance().config_loader())
        found = plugin._query(config_name=command, line=rest.lstrip())
    return [word for word in found if not word.endswith(SUFFIX) and not word.startswith("hydra")]


def _script(action: str, shell: str) -> None:
    """Print the script for the shell to evaluate."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    from ganlane.config.command_line import VERSION_BASE

    print(_BEFORE.get((action, shell), ""))
    before = sys.argv
    # Hydra reads the program's name here; with python -m ganlane it is the path of a module.
    sys.argv = [PROGRAM]
    try:
        with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE):
            hydra = GlobalHydra.instance().hydra
            assert hydra is not None
            hydra.shell_completion(config_name=_ANY, overrides=[f"{action}={shell}"])
    finally:
        sys.argv = before
