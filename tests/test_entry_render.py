"""``ganlane render`` from end to end, in process."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from ganlane.render import main

SHORT = ["env.goal_m=40", "film.fps=5", "film.width=640", "film.height=160"]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("agent", ["mobil", "random"])
def test_an_episode_becomes_a_film(agent, capsys):
    assert main([*SHORT, f"agent={agent}", "episode=2"]) == 0
    film = Path(capsys.readouterr().out.splitlines()[-1].removeprefix("film: "))
    assert film.name == f"{agent}_idm_mobil_0_2.gif"
    with Image.open(film) as picture:
        assert picture.size == (640, 160)
        assert picture.n_frames > 3


def test_the_film_goes_where_it_is_wanted(capsys, tmp_path):
    assert main([*SHORT, "traffic=idm", "format=png", "out=strip.png"]) == 0
    assert Image.open(tmp_path / "strip.png").height > 4 * 160
    assert "goal after" in capsys.readouterr().out


def test_an_unknown_driver_leaves_nothing(capsys, tmp_path):
    assert main([*SHORT, "agent=nobody"]) == 2
    assert "agent nobody: unknown" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
