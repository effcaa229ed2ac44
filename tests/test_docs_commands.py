"""Every command in README and the pages is one that the records accept."""

import re
import shlex
from functools import cache

import pytest
from reference.processes import ROOT

from ganlane.config.run import COMMANDS, parsed, settings, single_runs
from ganlane.sim import scenes

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Between backquotes, or a line of a block of code; a backslash at its end goes on.
COMMAND = re.compile(
    r"(?:`|^(?: {4})?)(?:python -m )?ganlane[ .](\w+)((?: [^`\n]+)?)", re.MULTILINE
)
#: Names in capitals, and files that a reader would have.
PLACEHOLDER = re.compile(r"RUN\b|SWEEP|NAME|my_scene|\.\.\.|--help|--version|lanes=40|resume=auto")


def commands_of(page):
    """Command and words of every command line on a page."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for match in COMMAND.finditer(text):
        command, rest = match[1], match[2].partition(" #")[0]
        if command in COMMANDS and "=" in rest and not PLACEHOLDER.search(rest):
            yield command, shlex.split(rest)


@pytest.fixture(scope="module")
def one_drive():
    """One drive shows whether a first scene can do without a crash.

    It is remembered here alone, since a command drives more.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "DRIVES", 1)
        patch.setattr(scenes, "_first_overlap", cache(scenes._first_overlap.__wrapped__))
        yield


@pytest.mark.usefixtures("one_drive")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_is_accepted(page):
    for command, words in commands_of(page):
        accept(command, *words)


@cache
def accept(command, *words):
    """Once, on whichever page it stands."""
    if "-m" in words:
        words = single_runs(parsed(command, [word for word in words if word != "-m"]))[0]
    settings(command, words)


def test_the_commands_are_found():
    assert sum(len(list(commands_of(page))) for page in PAGES) > 90


def test_a_commands_module_is_run_in_one_way_alone():
    old = re.compile(r"python -m ganlane\.(\w+)")
    for page in PAGES:
        names = set(old.findall(page.read_text(encoding="utf-8"))) & COMMANDS.keys()
        assert names <= {"train"}, page.name
