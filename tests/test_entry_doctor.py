"""``ganlane doctor`` reports what is there, what is missing, and the command that mends it."""

from __future__ import annotations

import re
from pathlib import Path
from unittest.mock import Mock

import pytest

from ganlane import doctor
from ganlane.__main__ import commands, main
from ganlane.errors import UserError
from ganlane.native import library
from ganlane.native.tensors import Kernel

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.usefixtures("empty_folder")


def test_a_whole_installation_is_found_whole_and_nothing_is_written(tmp_path, capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    subjects = {" ".join(line.split()[:2]) for line in lines}
    assert {"ok torch", "ok hydra-core", "ok devices", "ok native"} <= subjects
    assert any(line.split()[1] == "recordings" for line in lines)
    assert "wandb for extra wandb" in "\n".join(lines)
    assert "ruff" not in "\n".join(lines)
    assert list(tmp_path.iterdir()) == []


def test_what_is_needed_and_missing_makes_the_status_1(monkeypatch, capsys):
    asked = ["numpy>=999", "nothing-of-that-name>=1; extra == 'more'"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: asked)
    assert main(["doctor"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("MISSING  numpy ")
    assert lines[1].endswith(
        'needed >=999; run python -m pip install --force-reinstall "numpy>=999"'
    )
    assert lines[2].startswith("absent   nothing-of-that-name for extra more")


def test_help_is_printed_and_keys_are_refused(capsys):
    assert main(["doctor", "--help"]) == 0
    assert "exit status" in capsys.readouterr().out
    assert main(["doctor", "seed=1"]) == 2
    told = "ganlane doctor: seed=1: it takes no keys; run ganlane doctor alone.\n"
    assert capsys.readouterr().err == told


@pytest.mark.parametrize(
    ("version", "allowed"),
    [("2.11", True), ("2.13.0+cpu", True), ("2.10.9", False), ("2.14.0", False), ("10.0", False)],
)
def test_versions_are_compared_as_numbers(version, allowed, monkeypatch):
    monkeypatch.setattr(doctor.metadata, "version", lambda name: version)
    if allowed:
        assert doctor.dependency("torch>=2.11,<2.14") == version
    else:
        with pytest.raises(UserError, match=r"needed .*; run python -m pip install"):
            doctor.dependency("torch>=2.11,<2.14")


def test_a_package_that_cannot_be_imported_is_missing(monkeypatch, capsys):
    broken = Mock(side_effect=OSError("lib.so:\n undefined symbol"))
    monkeypatch.setattr(doctor.importlib, "import_module", broken)
    assert not doctor.look("numpy", lambda: doctor.dependency("numpy>=1.26"), needed=True)
    told = capsys.readouterr().out
    assert "lib.so: undefined symbol; run python -m pip install" in told
    assert told.count("\n") == 1


def test_recordings_are_found_or_asked_for(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    with pytest.raises(UserError, match="set GANLANE_DATA"):
        doctor.recordings()
    (tmp_path / "us101_scenes.csv").touch()
    assert doctor.recordings() == str(tmp_path / "us101_scenes.csv")


def test_the_kernel_is_driven_and_without_one_a_compiler_asked_for(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("ganlane.native.library.compilers", lambda: ())
        with pytest.raises(UserError, match=r"there is no C\+\+ compiler; install g"):
            doctor.kernel()
    if library.why_not() is not None:
        return
    loaded = library.find()
    told = f"{loaded.variant}, by {loaded.maker}, drives as the tensor code does"
    assert doctor.kernel() == told
    # As the library of a compiler that is broken would.
    monkeypatch.setattr(Kernel, "decide", lambda self, action, state, recycles: state.clone())
    with pytest.raises(UserError, match=r"its kernel drives .* m away from the tensor code"):
        doctor.kernel()


def test_the_page_names_every_command():
    page = (ROOT / "docs" / "command_line.md").read_text()
    for name in commands():
        assert re.search(rf"^\| `{name}` \|", page, flags=re.MULTILINE), name
