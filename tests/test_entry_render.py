"""``ganlane render`` from end to end, in process."""

import json
import re
from functools import partial

import pytest
from PIL import Image
from reference.refusals import last_path

from ganlane.config.run import run_command
from ganlane.data import read_scenes

SHORT = ["env.goal_m=40", "film.fps=5", "film.width=640", "film.height=160"]
main = partial(run_command, "render")
pytestmark = pytest.mark.usefixtures("empty_folder")


def test_an_episode_becomes_a_film(capsys):
    assert main([*SHORT, "agent=random", "episode=2"]) == 0
    film = last_path(capsys.readouterr().out)
    assert film.name == "random_idm_mobil_0_2.gif"
    with Image.open(film) as picture:
        assert picture.size == (640, 160)
        assert picture.n_frames > 3


def test_the_film_goes_where_it_is_wanted_in_the_format_of_its_ending(capsys, tmp_path):
    assert main([*SHORT, "traffic=idm", "agent=keep_lane", "out=film.GIF"]) == 0
    with Image.open(tmp_path / "film.GIF") as film:
        assert film.format == "GIF"
    assert "goal after" in capsys.readouterr().out


def test_agents_and_episodes_play_beside_each_other(capsys, tmp_path):
    assert main([*SHORT, "agents=[keep_lane,agent_idm]", "episodes=[2,5]", "out=player.html"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "player: player.html"
    page = (tmp_path / "player.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])["episodes"]
    assert [(shown["agent"], shown["episode"]) for shown in data] == [
        ("keep_lane", 2),
        ("agent_idm", 2),
        ("keep_lane", 5),
        ("agent_idm", 5),
    ]
    assert [len(shown["action_values"]) for shown in data] == [0, 3, 0, 3]
    assert all(shown["reward"] for shown in data)


def test_simulated_traffic_is_replayed_like_recorded_traffic(capsys):
    assert main(["env.goal_m=300", "agent=keep_lane", "episodes=[0,1]", "out=all.parquet"]) == 0
    path = last_path(capsys.readouterr().out)
    assert read_scenes(path)["scene"].n_unique() == 2
    replay = [
        "traffic=replay",
        f"traffic.path={path}",
        "film.end_s=5",
        "out=again.parquet",
    ]
    assert main([*replay, "agent=keep_lane"]) == 0
    assert "on replay" in capsys.readouterr().out
    assert read_scenes("again.parquet")["vehicle"].n_unique() > 1


def test_curves_of_runs_come_in_the_format_that_is_asked_for(capsys, tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text(
            "decisions,mean_return,crash_rate\n1,2,0.5\n10,3,0.2\n"
        )
    assert main(["run=[first,second]", "out=curves.svg"]) == 0
    assert capsys.readouterr().out == "curves: curves.svg\n"
    assert (tmp_path / "curves.svg").read_bytes().startswith(b"<?xml")
