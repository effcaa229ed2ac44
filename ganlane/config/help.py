"""``--help`` and ``--help-all`` from docstrings and YAML files.

Options and keys completed in a shell by Hydra.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import Any

from hydra import initialize_config_dir
from hydra._internal.core_plugins.bash_completion import BashCompletion
from hydra.core.global_hydra import GlobalHydra

from ganlane.config.command_line import VERSION_BASE
from ganlane.config.schemas import SCHEMAS, SUFFIX, chosen_options, option_of, options_of, register
from ganlane.errors import as_typed
from ganlane.files import conf_folder
from ganlane.parameters import NO_KEY

#: Column at which the meanings of keys begin, and where their lines end.
_COLUMN, _END = 34, 118
_FLAGS = """flags
  -m, --multirun       a sweep over values with commas, each run in its own folder: ganlane {command} -m seed=0,1
  --cfg job            print the whole configuration and stop; with --resolve its references filled in
  --hydra-help         Hydra's own flags; --shell-completion for bash, zsh and fish

exit status: 0 done, 2 a mistake in configuration, file or checkpoint or a disk that refuses, 130 stopped by Ctrl-C,
143 by SIGTERM, 141 the reader of the output has left"""

#: Missing in Hydra's scripts: zsh needs bashcompinit, and bash must forget the removed function.
_BEFORE = {
    ("install", "zsh"): "(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }\n"
    "autoload -Uz bashcompinit && bashcompinit",
    ("uninstall", "bash"): "complete -r ganlane 2> /dev/null",
    ("uninstall", "zsh"): "complete -r ganlane 2> /dev/null",
}


def help_text(command: str, everything: bool = True) -> str:
    """The text of ``ganlane COMMAND --help-all``; unless ``everything``, that of ``--help``."""
    chosen = chosen_options(command)
    groups = {mount: option for mount, option in chosen.items() if "@" not in mount}
    listed = (
        [_options(*each) for each in chosen.items()]
        if everything
        else map(_names, groups, groups.values())
    )
    parts = [
        _purpose(command),
        "options (GROUP=NAME; * is the default)\n" + "\n".join(listed),
        "keys (KEY=VALUE)\n"
        + "\n".join(key_lines(SCHEMAS[""][command], {}, 2, {*groups, "traffic_options"})),
    ]
    for group, option in groups.items() if everything else ():
        if option is not None:
            lines = key_lines(*option_of(group, option), 4)
            parts.append("\n".join([f"keys of {group}={option}", f"  {group}:", *lines]))
    more = (
        []
        if everything
        else [f"ganlane {command} --help-all explains every option, and lists their keys."]
    )
    return "\n\n".join([*parts, *more, _FLAGS.format(command=command)])


def _purpose(command: str) -> str:
    """The docstring of the command's module, without what it says of the modules below."""
    text = inspect.getdoc(importlib.import_module(f"ganlane.{command}")) or ""
    return _plain(text.partition("\n\nModules")[0])


def _names(group: str, default: str | None) -> str:
    names = " ".join(f"{name}*" if name == default else name for name in options_of(group))
    return textwrap.fill(names, _END, initial_indent=f"  {group:<13}", subsequent_indent=" " * 15)


def _options(mount: str, default: str | None) -> str:
    """A group's options with the first lines of their YAML."""
    group, _, place = mount.partition("@")
    if place.startswith("traffic_options."):
        return f"  {place}.KEY: the keys of traffic={default} (ganlane train --help shows some)"
    if place:
        return f"  {mount}: the options of {group}; {as_typed(default)} by default"
    lines = [
        f"   {'*' if name == default else ' '} {name:<18}{summary(group, name)}"
        for name in options_of(group)
    ]
    return "\n".join([f"  {mount}", *lines])


def summary(group: str, name: str) -> str:
    """The first comment of an option's YAML that is not a directive."""
    text = (conf_folder() / group / f"{name}.yaml").read_text()
    comments = [line[1:].strip() for line in text.splitlines() if line.startswith("#")]
    return next((comment for comment in comments if not comment.startswith("@package")), "")


def key_lines(
    kind: Any,
    values: Mapping[str, Any],
    indent: int,
    without: set[str] | frozenset[str] = frozenset(),
) -> Iterator[str]:
    """A line for every key of a dataclass.

    Its default, or its value in ``values``, and what it means.
    """
    for field in fields(kind):
        if field.name in without or field.metadata == NO_KEY:
            continue
        default = field.default if field.default_factory is MISSING else field.default_factory()
        value, key = values.get(field.name, default), f"{' ' * indent}{field.name}:"
        # The first sentence on it in the docstring of its class or of a base class.
        meaning = next(
            (found for base in kind.__mro__ if (found := _attributes(base).get(field.name))), ""
        )
        if is_dataclass(value):
            yield from _lines(key, meaning)
            own = {known.name: getattr(value, known.name) for known in fields(value)}
            yield from key_lines(type(value), own, indent + 2)
        elif not (isinstance(value, dict) and any(map(is_dataclass, value.values()))):
            yield from _lines(f"{key} {as_typed(value)}", meaning)


def _lines(key: str, meaning: str) -> Iterator[str]:
    """The key, and its meaning in a column of its own."""
    first, *rest = textwrap.wrap(meaning, _END - _COLUMN - 2) or [""]
    yield f"{key:<{_COLUMN - 1}} # {first}" if first else key
    yield from (f"{'':<{_COLUMN}}# {line}" for line in rest)


@cache
def _attributes(kind: type) -> dict[str, str]:
    """First sentences of the section ``Attributes`` of a class's docstring, by field."""
    _, _, section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
    items = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, flags=re.MULTILINE)
    joined = {name: " ".join(text.split()) for name, text in items}
    return {
        name: _plain(re.split(r"\.(?= [A-Z])", text)[0].rstrip("."))
        for name, text in joined.items()
    }


def _plain(text: str) -> str:
    """The text without reStructuredText roles: ``:data:`~ganlane.NAME``` becomes NAME."""
    return re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", text).replace("``", "")


def completed(command: str, rest: str) -> list[str]:
    """Hydra's completions of ``rest``, what follows a command, without the names of schemas."""
    register(command)
    with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE, job_name=command):
        plugin = BashCompletion(GlobalHydra.instance().config_loader())
        found = plugin._query(config_name=command, line=rest.lstrip())
    return [word for word in found if not word.endswith(SUFFIX) and not word.startswith("hydra")]


def print_completion_script(action: str, shell: str) -> None:
    """Print the script for the shell to evaluate."""
    print(_BEFORE.get((action, shell), ""))
    before = sys.argv
    # Hydra reads the program's name here; with python -m ganlane it is the path of a module.
    sys.argv = ["ganlane"]
    try:
        with initialize_config_dir(str(conf_folder()), version_base=VERSION_BASE):
            hydra = GlobalHydra.instance().hydra
            assert hydra is not None
            hydra.shell_completion(config_name="train", overrides=[f"{action}={shell}"])
    finally:
        sys.argv = before
