"""``ganlane doctor`` reports what is there, what is missing, and the command that fixes it."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from ganlane import doctor
from ganlane.__main__ import COMMANDS, PLAIN_COMMANDS, main
from ganlane.doctor import Finding, State
from ganlane.files import CHECKPOINTS

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
#: Extras for developers, which include the others.
FOR_DEVELOPERS = {"test", "dev"}


pytestmark = pytest.mark.usefixtures("empty_folder")


def test_a_whole_installation_is_found_whole(tmp_path, capsys):
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    for part in (
        "python",
        "torch",
        "devices",
        "C++ compiler",
        "agent_idm",
        "recordings",
        "cache",
        "extra video",
    ):
        assert f" {part} " in shown
    assert shown.endswith(
        "All that is needed is there; what is absent serves further purposes only.\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_what_is_needed_and_missing_makes_the_status_1(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ganlane.doctor.CHECKPOINTS", tmp_path)
    assert main(["doctor"]) == 1
    shown = capsys.readouterr().out
    assert "MISSING agent_idm" in shown
    assert "fix: python -m pip install" in shown
    assert shown.splitlines()[-1].startswith(
        "Missing: agent_idm, generator_calibrated, generator_paper;"
    )


def test_help_is_printed_and_keys_are_refused(capsys):
    assert main(["doctor", "--help"]) == 0
    assert "exit status" in capsys.readouterr().out
    assert main(["doctor", "seed=1"]) == 2
    assert (
        capsys.readouterr().err
        == "ganlane doctor: seed=1: it takes no keys; run ganlane doctor alone.\n"
    )


def test_it_asks_for_what_the_package_asks_for():
    assert list(doctor.REQUIRED) == PROJECT["dependencies"]
    extras = PROJECT["optional-dependencies"]
    assert extras.keys() - FOR_DEVELOPERS <= doctor.EXTRAS.keys()
    for name in extras.keys() & doctor.EXTRAS.keys():
        assert list(doctor.EXTRAS[name][1]) == extras[name], name


@pytest.mark.parametrize(
    ("version", "allowed"),
    [
        ("2.11", True),
        ("2.11.0", True),
        ("2.13.0+cpu", True),
        ("2.10.9", False),
        ("2.14.0", False),
        ("10.0", False),
    ],
)
def test_versions_are_compared_as_numbers(version, allowed, monkeypatch):
    monkeypatch.setattr("ganlane.doctor.metadata.version", lambda name: version)
    assert doctor.installed("torch>=2.11,<2.14") == ("torch", version, allowed)


def test_a_package_that_is_not_there_comes_with_its_command():
    fix = 'python -m pip install "no-such-package>=1.0"'
    assert doctor.required("no-such-package>=1.0") == Finding(
        "no-such-package", State.MISSING, "not installed", fix
    )
    assert doctor.required("numpy>=999").state is State.MISSING


def test_a_package_that_cannot_be_imported_is_missing(monkeypatch):
    broken = Mock(side_effect=OSError("lib.so:\n undefined symbol"))
    monkeypatch.setattr("ganlane.doctor.importlib.import_module", broken)
    fix = 'python -m pip install "numpy>=1.26" --force-reinstall'
    assert doctor.required("numpy>=1.26") == Finding(
        "numpy", State.MISSING, "lib.so: undefined symbol", fix
    )


def test_an_extra_names_only_what_it_lacks(monkeypatch):
    monkeypatch.setitem(doctor.EXTRAS, "mixed", ("counting", ("numpy>=1.26", "no-such-package>=1")))
    fix = 'python -m pip install "no-such-package>=1"'
    lacking = "counting: no-such-package not installed"
    assert doctor.extra("mixed") == Finding("extra mixed", State.ABSENT, lacking, fix)


def test_a_damaged_checkpoint_is_missing(tmp_path, monkeypatch):
    for file in CHECKPOINTS.glob("*.safetensors"):
        (tmp_path / file.name).write_bytes(
            file.read_bytes()[: -100 if "paper" in file.name else None]
        )
    monkeypatch.setattr("ganlane.doctor.CHECKPOINTS", tmp_path)
    assert {found.subject for found in doctor.checkpoints() if found.state is State.MISSING} == {
        "generator_paper"
    }


def test_recordings_are_found_or_asked_for(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    assert doctor.recordings().state is State.ABSENT
    assert "export GANLANE_DATA=FOLDER" in doctor.recordings().fix
    (tmp_path / "us101_scenes.csv").write_bytes(b"x" * 2**20)
    assert doctor.recordings().found == f"{tmp_path / 'us101_scenes.csv'} (1.0 MB)"


def test_cache_and_run_folders(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_CACHE", "")
    assert doctor.cache().found == "off (GANLANE_CACHE is empty)"
    monkeypatch.setenv("GANLANE_CACHE", str(tmp_path / "cache"))
    assert doctor.cache().found == f"{tmp_path / 'cache' / 'native'} (0 files, 0.0 MB)"
    (tmp_path / "cache").write_text("in the way")
    assert doctor.cache().state is State.ABSENT
    assert doctor.outputs().state is State.OK
    (tmp_path / "outputs").write_text("in the way")
    assert doctor.outputs().state is State.MISSING


def test_a_machine_without_compiler_is_told_what_to_install(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    found = doctor.machine()[-1]
    assert found.state is State.ABSENT
    assert "no-such-compiler" in found.found
    assert found.fix


def test_the_report_shows_every_finding_and_its_command():
    sections = {
        "software": [
            Finding("torch", State.OK, "2.13"),
            Finding("numpy", State.MISSING, "gone", "do this"),
        ]
    }
    assert doctor.missing(sections) == ["numpy"]
    assert doctor.report(sections).splitlines() == [
        "software",
        "  ok      torch                 2.13",
        "  MISSING numpy                 gone",
        "          fix: do this",
        "",
        "Missing: numpy; run the commands after 'fix:'.",
    ]


def test_the_page_names_every_command():
    page = (ROOT / "docs" / "command_line.md").read_text()
    for name in (*COMMANDS, *PLAIN_COMMANDS):
        assert re.search(rf"^\| `{name}` \|", page, flags=re.MULTILINE), name
