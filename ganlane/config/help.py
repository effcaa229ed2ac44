"""``--help``: what a command does, its options and its keys, read from the files that hold them."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path

from ganlane.files import conf_folder

_FLAGS = """flags
  -m, --multirun       a sweep over values with commas, each run in its own folder: ganlane {command} -m seed=0,1
  --cfg job            print the whole configuration and stop; with --resolve its references filled in
  --hydra-help         Hydra's own flags; --shell-completion for bash, zsh and fish

exit status: 0 done, 2 a mistake in configuration, file or checkpoint or a disk that refuses, 130 stopped by Ctrl-C,
143 by SIGTERM, 141 the reader of the output has left"""


def help_text(command: str) -> str:
    """All that ``ganlane COMMAND --help`` prints."""
    folder = conf_folder()
    root = (folder / f"{command}.yaml").read_text()
    chosen = chosen_options(root)
    story = inspect.getdoc(importlib.import_module(f"ganlane.{command}")) or ""
    parts = [
        story,
        "options (GROUP=NAME; * is the default)\n"
        + "\n".join(_group(folder, *mounted) for mounted in chosen.items()),
        "keys (KEY=VALUE)\n" + indented(keys_of(root), 2),
    ]
    parts += [
        _option_keys(folder, mount, option)
        for mount, option in chosen.items()
        if option != "null" and "@" not in mount
    ]
    return "\n\n".join([*parts, _FLAGS.format(command=command)])


def print_help(command: str) -> None:
    """Print :func:`help_text`."""
    print(help_text(command))


def chosen_options(root: str) -> dict[str, str]:
    """Mounted group to default option, in the order of the ``defaults`` list; mounts below one key appear once."""
    found: dict[str, str] = {}
    for mount, option in re.findall(r"^  - ([\w@.]+): (\w+)", root, flags=re.MULTILINE):
        found.setdefault(mount, option)
    return found


def _group(folder: Path, mount: str, default: str) -> str:
    """A group's options with their first lines."""
    group, _, place = mount.partition("@")
    if place.startswith("traffic_options."):
        return f"  {place}.KEY: the keys of traffic={default} (ganlane train --help shows some)"
    lines = [f"  {mount}"]
    for path in sorted((folder / group).glob("*.yaml")):
        mark = "*" if path.stem == default else " "
        lines.append(f"   {mark} {path.stem:<18}{summary(path)}")
    return "\n".join(lines)


def summary(path: Path) -> str:
    """The first comment of a YAML file that is not a directive."""
    comments = [line[1:].strip() for line in path.read_text().splitlines() if line.startswith("#")]
    return next((comment for comment in comments if not comment.startswith("@package")), "")


def _option_keys(folder: Path, group: str, option: str) -> str:
    """The keys of an option below its group's name."""
    body = keys_of((folder / group / f"{option}.yaml").read_text())
    return f"keys of {group}={option}\n  {group}:\n" + indented(body, 4)


def keys_of(text: str) -> str:
    """A YAML file without its first comment, its ``defaults`` and what concerns Hydra alone."""
    kept, skipping = [], False
    for number, line in enumerate(text.splitlines()):
        if re.match(r"(defaults|hydra):", line):
            skipping = True
        elif line and not line[0].isspace() and not line.startswith("-"):
            skipping = False
        if not skipping and not (line.startswith("#") and number < 2):
            kept.append(line)
    return "\n".join(kept).strip("\n")


def indented(text: str, by: int) -> str:
    """``text`` moved to the right."""
    return "\n".join(" " * by + line if line else line for line in text.splitlines())
