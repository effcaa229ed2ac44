"""``ganlane doctor`` reports what is there, what is missing, and the command that mends it."""

import re

import pytest
from reference.processes import ROOT
from reference.refusals import user_error

from ganlane import doctor
from ganlane.__main__ import commands, main
from ganlane.native import library
from ganlane.native.tensors import Kernel

pytestmark = pytest.mark.usefixtures("empty_folder")


def test_a_whole_installation_is_found_whole_and_nothing_is_written(tmp_path, capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    subjects = {" ".join(line.split()[:2]) for line in lines}
    assert {"ok torch", "ok hydra-core", "ok devices", "ok native"} <= subjects
    assert any(line.split()[1] == "recordings" for line in lines)
    assert any(line.split()[1] == "wandb" for line in lines)
    assert list(tmp_path.iterdir()) == []


def test_what_is_needed_and_missing_makes_the_status_1(monkeypatch, capsys):
    asked = ["nothing-of-that-name>=1", "another-of-that-name>=1; extra == 'more'"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: asked)
    assert main(["doctor"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("MISSING  nothing-of-that-name ")
    assert lines[2].startswith("absent   another-of-that-name ")


def test_help_is_printed_and_keys_are_refused(capsys):
    assert main(["doctor", "--help"]) == 0
    assert "exit status" in capsys.readouterr().out
    assert main(["doctor", "seed=1"]) == 2
    told = "ganlane doctor: seed=1: it takes no keys; run ganlane doctor alone.\n"
    assert capsys.readouterr().err == told


def test_recordings_are_found_or_asked_for(no_recordings):
    with user_error("set GANLANE_DATA"):
        doctor.recordings()
    (no_recordings / "us101_scenes.csv").touch()
    assert doctor.recordings() == str(no_recordings / "us101_scenes.csv")


def test_the_kernel_is_driven_and_without_one_a_compiler_asked_for(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("ganlane.native.library.compilers", lambda: ())
        with user_error(r"there is no C\+\+ compiler; install g"):
            doctor.kernel()
    if library.why_not() is not None:
        return
    loaded = library.find()
    told = f"{loaded.variant}, by {loaded.maker}, drives as the tensor code does"
    assert doctor.kernel() == told
    # As the library of a compiler that is broken would.
    monkeypatch.setattr(Kernel, "decide", lambda self, action, state, recycles: state.clone())
    with user_error(r"its kernel drives .* m away from the tensor code"):
        doctor.kernel()


def test_the_page_names_every_command():
    page = (ROOT / "docs" / "command_line.md").read_text()
    for name in commands():
        assert re.search(rf"^\| `{name}` \|", page, flags=re.MULTILINE), name
