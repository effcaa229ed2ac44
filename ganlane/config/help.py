"""``--help`` from the records' docstrings and the first lines of the YAML files."""

from __future__ import annotations

import inspect
import itertools
import re
import textwrap
from collections.abc import Iterator
from dataclasses import is_dataclass

from ganlane.config.compose import composed
from ganlane.errors import as_typed
from ganlane.files import conf_folder
from ganlane.settings.record import Record, key_names, make, option_names

#: Column at which the meanings of keys begin, and where their lines end.
_COLUMN, _END = 34, 118
_FLAGS = """flags
  -m, --multirun       a sweep over values with commas, each run in its own folder
  --cfg job            print the whole configuration and stop

exit status: 0 done, 2 a mistake in configuration, file or checkpoint or a disk that refuses,
130 stopped by Ctrl-C, 143 by SIGTERM, 141 the reader of the output has left"""


def help_text(command: str, kind: type[Record]) -> str:
    """What a command is for, its groups' options, and every key with default and meaning."""
    # The defaults shown are those of the command's own YAML, not of the records.
    data = composed(command)
    folders = sorted(path.name for path in conf_folder().iterdir() if path.is_dir())
    keys = key_names(kind)
    groups = [
        name for name in folders if name in keys or (name == "experiment" and command == "train")
    ]
    options = [f"  {group}\n{_options(group)}" for group in groups]
    return "\n\n".join(
        [
            "\n".join(_comment(f"{command}.yaml")),
            "options (GROUP=NAME)\n" + "\n".join(options),
            "keys (KEY=VALUE, with the defaults)\n" + "\n".join(_keys(make(kind, data), 2)),
            _FLAGS,
        ]
    )


def _comment(file: str) -> list[str]:
    """The lines of the comment at the head of a YAML file."""
    lines = (conf_folder() / file).read_text(encoding="utf-8").splitlines()
    head = itertools.takewhile(lambda line: line.startswith("#"), lines)
    # Lines with @package are for Hydra, not for readers.
    texts = (line.removeprefix("#").removeprefix(" ") for line in head)
    return [text for text in texts if not text.startswith("@package")]


def _options(group: str) -> str:
    """A group's options, each with the first line of its file."""
    names = option_names(group)
    return "\n".join(f"    {name:<20}{_comment(f'{group}/{name}.yaml')[0]}" for name in names)


def _keys(record: Record, indent: int) -> Iterator[str]:
    """A line for every key of a record: its value, and what it means."""
    for name in key_names(type(record)):
        value, key = getattr(record, name), f"{' ' * indent}{name}:"
        text = meaning(type(record), name)
        # Of a mapping of records the names alone, since their keys would fill pages.
        if isinstance(value, dict) and any(map(is_dataclass, value.values())):
            value = list(value)
        # A record of its own: its line, then its keys below it.
        if is_dataclass(value):
            yield from _lines(key, text)
            yield from _keys(value, indent + 2)  # type: ignore[arg-type]
        else:
            yield from _lines(f"{key} {as_typed(value)}", text)


def _lines(key: str, text: str) -> Iterator[str]:
    """The key, and its meaning in a column of its own."""
    first, *rest = textwrap.wrap(text, _END - _COLUMN - 2) or [""]
    yield f"{key:<{_COLUMN - 1}} # {first}" if first else key
    yield from (f"{'':<{_COLUMN}}# {line}" for line in rest)


def meaning(kind: type, name: str) -> str:
    """The first sentence on a field in the docstring of its class or of a base class."""
    # A subclass may say something else about an inherited key.
    described = (_attributes(base) for base in kind.__mro__)
    return next((meanings[name] for meanings in described if name in meanings), "")


def _attributes(kind: type) -> dict[str, str]:
    """First sentences of the section ``Attributes`` of a class's docstring, by field."""
    _, _, section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
    # Google's docstring style: a name, a colon, lines that are indented further.
    items = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, flags=re.MULTILINE)
    meanings = {}
    for name, text in items:
        joined = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", " ".join(text.split()))
        meanings[name] = re.split(r"\.(?= [A-Z])", joined)[0].rstrip(".").replace("``", "")
    return meanings
