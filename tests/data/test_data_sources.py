"""Where recordings are, and how far reading them is."""

import sys

import pytest
from reference.refusals import user_error

from ganlane.data import byte_progress, default_scenes
from ganlane.data.sources import data_folder


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_shows_bytes_on_a_terminal_and_nothing_of_short_work_elsewhere(
    terminal, capsys, monkeypatch
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with byte_progress("read") as show:
        show(2_000_000, 4_000_000)
    err = capsys.readouterr().err
    assert ("read:  50%" in err and "2.00M/4.00M" in err) if terminal else err == ""


def test_the_recordings_are_found_through_the_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    with user_error(r"set GANLANE_DATA to a folder that holds ngsim/us101_scenes\.csv"):
        default_scenes()
    # First nothing, then a file, then no folder.
    (tmp_path / "ngsim").mkdir()
    deep = tmp_path / "ngsim" / "us101_scenes.csv"
    deep.write_text("scene,vehicle")
    assert default_scenes() == deep
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path / "nowhere"))
    with user_error("no such folder"):
        data_folder()


def test_the_recordings_are_found_beside_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    # As if the package were installed elsewhere.
    elsewhere = tmp_path / "site/ganlane/data/sources.py"
    monkeypatch.setattr("ganlane.data.sources.__file__", str(elsewhere))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    assert data_folder() is None
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert data_folder() == tmp_path / "shared" / "data"
