"""``--help`` and ``--help-all``: a command's purpose, options and keys, from docstrings and YAML files."""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import Any

from ganlane.config.schemas import SCHEMAS, option_of, options_of
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


def help_text(command: str, everything: bool = True) -> str:
    """The text of ``ganlane COMMAND --help-all``; unless ``everything``, that of ``--help``."""
    chosen = chosen_options((conf_folder() / f"{command}.yaml").read_text())
    groups = {mount: option for mount, option in chosen.items() if "@" not in mount}
    listed = [_options(*each) for each in chosen.items()] if everything else map(_names, groups, groups.values())
    parts = [
        inspect.getdoc(importlib.import_module(f"ganlane.{command}")) or "",
        "options (GROUP=NAME; * is the default)\n" + "\n".join(listed),
        "keys (KEY=VALUE)\n" + "\n".join(key_lines(SCHEMAS[""][command], {}, 2, {*groups, "traffic_options"})),
    ]
    for group, option in groups.items() if everything else ():
        if option != "null":
            lines = key_lines(*option_of(group, option), 4)
            parts.append("\n".join([f"keys of {group}={option}", f"  {group}:", *lines]))
    more = [] if everything else [f"ganlane {command} --help-all explains every option, and lists their keys."]
    return "\n\n".join([*parts, *more, _FLAGS.format(command=command)])


def _names(group: str, default: str) -> str:
    names = " ".join(f"{name}*" if name == default else name for name in options_of(group))
    return textwrap.fill(names, _END, initial_indent=f"  {group:<13}", subsequent_indent=" " * 15)


def chosen_options(root: str) -> dict[str, str]:
    """Mounted group to default option, in the order of the ``defaults`` list."""
    return dict(re.findall(r"^  - ([\w@.]+): (\w+)", root, flags=re.MULTILINE))


def _options(mount: str, default: str) -> str:
    """A group's options with the first lines of their YAML."""
    group, _, place = mount.partition("@")
    if place.startswith("traffic_options."):
        return f"  {place}.KEY: the keys of traffic={default} (ganlane train --help shows some)"
    if place:
        return f"  {mount}: the options of {group}; {default} by default"
    lines = [f"   {'*' if name == default else ' '} {name:<18}{summary(group, name)}" for name in options_of(group)]
    return "\n".join([f"  {mount}", *lines])


def summary(group: str, name: str) -> str:
    """The first comment of an option's YAML that is not a directive."""
    text = (conf_folder() / group / f"{name}.yaml").read_text()
    comments = [line[1:].strip() for line in text.splitlines() if line.startswith("#")]
    return next((comment for comment in comments if not comment.startswith("@package")), "")


def key_lines(
    kind: Any, values: Mapping[str, Any], indent: int, without: set[str] | frozenset[str] = frozenset()
) -> Iterator[str]:
    """A line for every key of a dataclass: its default, or its value in ``values``, and what it means."""
    for field in fields(kind):
        if field.name in without or field.metadata == NO_KEY:
            continue
        value = values[field.name] if field.name in values else _default(field)
        key, meaning = f"{' ' * indent}{field.name}:", _meaning(kind, field.name)
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


def _default(field: Field[Any]) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def _meaning(kind: Any, name: str) -> str:
    """The first sentence on a field in the docstring of its class or of a base class."""
    return next((found for base in kind.__mro__ if (found := _attributes(base).get(name))), "")


@cache
def _attributes(kind: type) -> dict[str, str]:
    """First sentences of the section ``Attributes`` of a class's docstring, by field."""
    _, _, section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
    items = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, flags=re.MULTILINE)
    joined = {name: " ".join(text.split()) for name, text in items}
    return {name: _plain(re.split(r"\.(?= [A-Z])", text)[0].rstrip(".")) for name, text in joined.items()}


def _plain(text: str) -> str:
    """The text without reStructuredText roles: ``:data:`~ganlane.NAME``` becomes NAME."""
    return re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", text).replace("``", "")
