"""How commands end: refused with status 2 and one sentence, nothing left behind.

Or naming their results.
"""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from ganlane.__main__ import main
from ganlane.errors import UserError


def user_error(sentence: str) -> AbstractContextManager[pytest.ExceptionInfo[UserError]]:
    """A user's mistake is refused within the block; ``sentence`` is a pattern of its message."""
    return pytest.raises(UserError, match=sentence)


def everything_below(folder: Path) -> dict[str, int]:
    """Every file and folder with its size."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*")}


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str, printed: bool = False) -> str:
    """The sentence with which a command line is refused, after all that it must not do was looked
    for.

    Nothing is on stdout, unless something may have been ``printed`` before.
    """
    before = everything_below(Path.cwd())
    status = main(arguments)
    out, err = capsys.readouterr()
    assert status == 2, (arguments, out, err)
    assert out == "" or printed
    assert is_one_sentence(err, arguments[0]), err
    assert everything_below(Path.cwd()) == before
    return err


def is_one_sentence(err: str, command: str) -> bool:
    """One line that names the command and ends in a full stop; no traceback."""
    return err.startswith(f"ganlane {command}: ") and err.endswith(".\n") and err.count("\n") == 1


def last_path(out: str) -> Path:
    """What the last line of a command's output names."""
    return Path(out.splitlines()[-1].partition(": ")[2])


def results_in(folder: Path) -> dict[str, Any]:
    """What a command has left in ``results.json``."""
    return json.loads((folder / "results.json").read_text())


class Bomb:
    """Unpickling it makes a file named ``executed``."""

    def __reduce__(self):
        return open, ("executed", "w")


def run_folder(config: str) -> None:
    """What a stopped training run leaves in the folder ``run``, as far as resuming reads it."""
    folder = Path("run")
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "last.pt").touch()
    (folder / "config.yaml").write_text(config)
