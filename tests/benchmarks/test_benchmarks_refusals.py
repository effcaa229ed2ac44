"""What benchmarks refuse before they measure."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks import crash_floor, drawing


@pytest.mark.parametrize("page", ["", "<!-- begin crash floor idm -->\n<!-- end crash floor idm -->\n", None])
def test_a_document_without_the_markers_is_refused_before_anybody_drives(page, tmp_path, monkeypatch, capsys):
    document, driven = tmp_path / "page.md", []
    if page is not None:
        document.write_text(page)
    monkeypatch.setattr(crash_floor, "rides_of", lambda *given: driven.append(given))
    assert crash_floor.main(["--traffic", "gan", "--report", str(document)]) == 2
    assert f"report={document}" in capsys.readouterr().err
    assert not driven


def test_more_frames_than_the_episode_has_are_refused(monkeypatch, capsys):
    monkeypatch.setattr(drawing, "episode", lambda length_s: range(400))
    assert drawing.main(["--frames", "80", "--rounds", "5"]) == 2
    assert "the episode has 400 frames" in capsys.readouterr().err
