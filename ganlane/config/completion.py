"""Shell completion of ``ganlane COMMAND ...``: Hydra's, with the command's own name completed first.

Hydra completes programs that are one command. Its shell function asks the program on the line, here ``ganlane``, so
the question comes without the command; it is read off the line and left out before Hydra looks at the rest.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Sequence

from hydra import initialize_config_dir
from hydra._internal.core_plugins.bash_completion import BashCompletion
from hydra.core.global_hydra import GlobalHydra

from ganlane.config.command_line import VERSION_BASE
from ganlane.config.schemas import SUFFIX, register
from ganlane.errors import UserError
from ganlane.files import conf_folder

SHELLS = ("bash", "zsh", "fish")
ACTIONS = ("install", "uninstall", "query")
PROGRAM = "ganlane"
#: Any command will do where only the script of the shell is wanted.
_ANY = "train"
#: What Hydra leaves out: zsh needs its layer for bash's completion, and bash keeps pointing at the removed function.
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
    """What to do, for which shell."""
    for argument in arguments:
        action, equals, shell = argument.partition("=")
        if equals and action in ACTIONS and shell in SHELLS:
            return action, shell
    example = f'eval "$({PROGRAM} -sc install=bash)"'
    raise UserError(f"{' '.join(arguments)}: expected for instance {example}; shells: {', '.join(SHELLS)}.")


def candidates(line: str, commands: Collection[str]) -> list[str]:
    """What the last word of ``line`` could become.

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
    """Hydra's answer for one command, without the names of schemas."""
    register(command)
    with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE, job_name=command):
        plugin = BashCompletion(GlobalHydra.instance().config_loader())
        found = plugin._query(config_name=command, line=rest.lstrip())
    return [word for word in found if not word.endswith(SUFFIX) and not word.startswith("hydra")]


def _script(action: str, shell: str) -> None:
    """Print what the shell is to evaluate."""
    print(_BEFORE.get((action, shell), ""))
    before = sys.argv
    # Hydra takes the program's name from there; python -m ganlane has the path of a module.
    sys.argv = [PROGRAM]
    try:
        with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE):
            hydra = GlobalHydra.instance().hydra
            assert hydra is not None
            hydra.shell_completion(config_name=_ANY, overrides=[f"{action}={shell}"])
    finally:
        sys.argv = before
