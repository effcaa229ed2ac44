"""Hydra's part of the shell completion: options and keys of a command, and the scripts for the shells."""

from __future__ import annotations

import sys

from hydra import initialize_config_dir
from hydra._internal.core_plugins.bash_completion import BashCompletion
from hydra.core.global_hydra import GlobalHydra

from ganlane.config.command_line import VERSION_BASE
from ganlane.config.completion import PROGRAM
from ganlane.config.schemas import SUFFIX, register
from ganlane.files import conf_folder

#: Any command serves to print the script of a shell.
_ANY = "train"
#: Missing in Hydra's scripts: zsh needs bashcompinit, and bash must forget the removed function.
_BEFORE = {
    ("install", "zsh"): "(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }\n"
    "autoload -Uz bashcompinit && bashcompinit",
    ("uninstall", "bash"): f"complete -r {PROGRAM} 2> /dev/null",
    ("uninstall", "zsh"): f"complete -r {PROGRAM} 2> /dev/null",
}


def completed(command: str, rest: str) -> list[str]:
    """Hydra's completions of ``rest``, what follows a command, without the names of schemas."""
    register(command)
    with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE, job_name=command):
        plugin = BashCompletion(GlobalHydra.instance().config_loader())
        found = plugin._query(config_name=command, line=rest.lstrip())
    return [word for word in found if not word.endswith(SUFFIX) and not word.startswith("hydra")]


def print_script(action: str, shell: str) -> None:
    """Print the script for the shell to evaluate."""
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
