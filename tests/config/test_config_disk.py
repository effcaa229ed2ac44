"""A disk that refuses ends a command with one sentence and status 2, and nothing half-written is left."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from ganlane.config.app import run_command
from ganlane.config.command_line import sentence
from ganlane.errors import ADVICE, is_users_matter
from ganlane.files import write_bytes


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(capsys, task, *arguments):
    """The sentence with which ``ganlane evaluate`` ends when its task is this one; nothing new is left."""
    before = sorted(Path.cwd().rglob("*"))
    assert run_command("evaluate", arguments, task) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("ganlane evaluate: ")
    assert err.endswith(".\n")
    assert err.count("\n") == 1
    assert sorted(Path.cwd().rglob("*")) == before
    return err


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.ENOSPC, "No space left on device; make room there"),
        (errno.EROFS, "Read-only file system; check the permissions"),
    ],
)
def test_a_refusal_while_a_command_writes(number, told, capsys):
    def task(config, folder):
        write_bytes(folder / "first.txt", b"whole")
        with (folder / "second.txt").open("w") as file:
            file.write("half")
            raise OSError(number, os.strerror(number), str(folder / "second.txt"))

    err = refused(capsys, task)
    assert f"second.txt: {told}" in err


@pytest.mark.parametrize("kind", [OSError, RuntimeError])
def test_a_library_that_gives_the_number_in_its_text_alone(kind, capsys):
    """So does polars."""

    def task(config, folder):
        raise kind("underlying IO error: No space left on device (os error 28)")

    assert "a file or standard output: No space left on device; make room" in refused(capsys, task)


def test_what_was_earned_before_the_disk_was_full_stays(here, capsys):
    def task(config, folder):
        write_bytes(folder / "agent.safetensors", b"trained for hours")
        raise OSError(errno.ENOSPC, "No space left on device")

    assert run_command("evaluate", ["hydra.run.dir=run"], task) == 2
    assert capsys.readouterr().err == (
        "ganlane evaluate: a file or standard output: No space left on device; "
        "make room there, or write to another disk.\n"
    )
    assert (here / "run" / "agent.safetensors").read_bytes() == b"trained for hours"


def test_a_run_folder_below_a_file(here, capsys):
    (here / "file").write_text("no folder")
    err = refused(capsys, lambda config, folder: None, "hydra.run.dir=file/run")
    assert "file/run: Not a directory; check the path." in err


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the administrator may write anywhere")
def test_a_folder_without_the_right_to_write(here, capsys):
    here.chmod(0o555)
    try:
        assert "Permission denied; check the permissions" in refused(capsys, lambda config, folder: None)
    finally:
        here.chmod(0o755)


def test_what_no_user_can_mend_keeps_its_traceback(here):
    def task(config, folder):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")

    with pytest.raises(ConnectionRefusedError):
        run_command("evaluate", [], task)
    assert list(here.rglob("*")) == []
    assert not is_users_matter(OSError("libfile.so: undefined symbol"))
    assert not is_users_matter(ValueError(errno.ENOSPC))


@pytest.mark.parametrize("number", ADVICE, ids=errno.errorcode.get)
def test_every_refusal_has_a_sentence(number):
    told = sentence(OSError(number, os.strerror(number), "a.txt"))
    assert told == f"a.txt: {os.strerror(number)}; {ADVICE[number]}."
    assert is_users_matter(OSError(number, ""))
