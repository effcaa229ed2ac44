"""Where the recordings are looked for."""

import pytest

from ganlane.data import data_folder, default_scenes
from ganlane.errors import UserError


def test_the_recordings_are_found_through_the_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    with pytest.raises(UserError, match=r"set GANLANE_DATA to a folder that holds ngsim/us101_scenes\.csv"):
        default_scenes()
    (tmp_path / "ngsim").mkdir()
    deep = tmp_path / "ngsim" / "us101_scenes.csv"
    deep.write_text("scene,vehicle")
    assert default_scenes() == deep
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match="no such folder"):
        data_folder()


def test_the_recordings_are_found_beside_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("GANLANE_DATA", raising=False)
    monkeypatch.setattr("ganlane.data.download.__file__", str(tmp_path / "site" / "ganlane" / "data" / "download.py"))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    assert data_folder() is None
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert data_folder() == tmp_path / "shared" / "data"
