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

#: Column at which the meanings of keys begin.
_COLUMN = 34
#: Column at which their lines end.
_END = 118
#: The last paragraphs of every help text.
_FLAGS = """flags
  -m, --multirun       a sweep over values with commas, each run in its own folder
  --cfg job            print the whole configuration and stop

exit status: 0 done, 2 a mistake in configuration, file or checkpoint or a disk that refuses,
130 stopped by Ctrl-C, 143 by SIGTERM, 141 the reader of the output has left"""


def help_text(command: str, kind: type[Record]) -> str:
    """What a command is for, its groups' options, and every key with default and meaning."""
    # The defaults shown are those of the command's own YAML, not of the records.
    data = composed(command)
    defaults = make(kind, data)

    # A folder of options belongs to the key of its name; an experiment sets keys of training.
    names = set(key_names(kind))
    if command == "train":
        names.add("experiment")
    folders = sorted(path.name for path in conf_folder().iterdir() if path.is_dir())
    options = [f"  {group}\n{_options(group)}" for group in folders if group in names]

    return "\n\n".join(
        [
            "\n".join(_comment(f"{command}.yaml")),
            "options (GROUP=NAME)\n" + "\n".join(options),
            "keys (KEY=VALUE, with the defaults)\n" + "\n".join(_keys(defaults, 2)),
            _FLAGS,
        ]
    )


def _comment(file: str) -> list[str]:
    """The lines of the comment at the head of a YAML file, given by its path below ``conf/``."""
    lines = (conf_folder() / file).read_text(encoding="utf-8").splitlines()
    head = itertools.takewhile(lambda line: line.startswith("#"), lines)
    texts = (line.removeprefix("#").removeprefix(" ") for line in head)
    # Lines with @package are for Hydra, not for readers.
    return [text for text in texts if not text.startswith("@package")]


def _options(group: str) -> str:
    """A group's options, each with the first line of its file."""
    lines = []
    for name in option_names(group):
        first = _comment(f"{group}/{name}.yaml")[0]
        lines.append(f"    {name:<20}{first}")
    return "\n".join(lines)


def _keys(record: Record, indent: int) -> Iterator[str]:
    """A line for every key of a record: its value, and what it means."""
    for name in key_names(type(record)):
        key = f"{' ' * indent}{name}:"
        value = getattr(record, name)
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
    """The key, and its meaning in a column of its own, in as many lines as it needs."""
    # Without a meaning the key stands alone. "# " takes two columns.
    first, *rest = textwrap.wrap(text, _END - _COLUMN - 2) or [""]
    yield f"{key:<{_COLUMN - 1}} # {first}" if first else key
    for line in rest:
        yield f"{'':<{_COLUMN}}# {line}"


def meaning(kind: type, name: str) -> str:
    """The first sentence on a field in the docstring of its class or of a base class.

    Empty where none of them describes it.
    """
    # The class before its bases: it may say something else about an inherited key.
    for base in kind.__mro__:
        meanings = _attributes(base)
        if name in meanings:
            return meanings[name]
    return ""


def _attributes(kind: type) -> dict[str, str]:
    """First sentences of the section ``Attributes`` of a class's docstring, by field."""
    _, _, section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
    # Google's docstring style: a name, a colon, lines that are indented further.
    items = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, flags=re.MULTILINE)
    meanings = {}
    for name, text in items:
        line = " ".join(text.split())
        # Sphinx's roles are for the pages: :class:`~ganlane.env.Name` becomes Name.
        plain = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", line)
        # A sentence ends with a full stop before a capital letter.
        sentence = re.split(r"\.(?= [A-Z])", plain)[0]
        meanings[name] = sentence.rstrip(".").replace("``", "")
    return meanings
