"""Pictures, videos and the window of the gymnasium environments."""

import itertools
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from reference.gym_env import ID, KEEP, make, make_vec, until_the_end
from reference.refusals import user_error

from ganlane.gym.window import FilmWindow


def test_frames_show_the_road_and_change_as_the_ego_drives():
    env = make(render_mode="rgb_array")
    envs = make_vec(2, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, env.render())
    env.step(KEEP)
    assert not np.array_equal(first, env.render())
    envs.reset(seed=0)
    one, other = envs.render()
    assert first.shape == one.shape == other.shape == (320, 1280, 3)
    assert not np.array_equal(one, other)


def test_a_list_of_frames_has_ten_for_every_second_of_driving():
    env = make(render_mode="rgb_array_list", goal_m=300.0)
    assert env.metadata["render_fps"] == 10
    env.reset(seed=0)
    assert len(env.render()) == 1
    assert env.render() == []
    env.step(KEEP)
    env.step(KEEP)
    frames = env.render()
    assert len(frames) == 20
    assert not any(np.array_equal(*two) for two in itertools.pairwise(frames))


@pytest.mark.parametrize("smooth", [True, False])
def test_videos_are_recorded_decision_by_decision_or_ten_times_a_second(tmp_path, smooth):
    moviepy = pytest.importorskip(
        "moviepy", reason="moviepy, which gymnasium's RecordVideo needs, is not installed"
    )
    video = gymnasium.wrappers.RecordVideo(
        make(render_mode="rgb_array", goal_m=30.0), str(tmp_path / "films")
    )
    if smooth:
        video.unwrapped.set_record_video_wrapper(video)
    video.reset(seed=0)
    *_, info = until_the_end(video)
    video.close()
    (film,) = (tmp_path / "films").glob("*.mp4")
    with moviepy.VideoFileClip(str(film)) as clip:
        assert clip.fps == (10 if smooth else 1)
        assert clip.n_frames == (round(info["time_s"] * 10) if smooth else info["decisions"]) + 1


def test_a_window_shows_every_physics_step(monkeypatch):
    window = Mock(spec=FilmWindow)
    monkeypatch.setattr("ganlane.gym.single.FilmWindow", lambda: window)
    monkeypatch.setattr("ganlane.gym.single.has_display", lambda: True)
    env = make(render_mode="human")
    assert env.unwrapped.metadata["render_modes"] == ["human", "rgb_array", "rgb_array_list"]
    env.reset(seed=0)
    assert window.show.call_count == 1
    env.step(KEEP)
    assert window.show.call_count == 11
    assert 0.0 < sum(call.args[0] for call in window.wait.call_args_list) <= 1.1
    assert env.render() is None
    env.close()
    window.close.assert_called_once()


@pytest.fixture
def pygame(monkeypatch):
    """With SDL's driver that shows nothing."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return pytest.importorskip("pygame", reason="pygame is not installed")


def test_the_window_shows_the_picture_until_it_is_closed(pygame):
    window = FilmWindow()
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[10, 20] = (1, 2, 3)
    window.show(picture)
    assert pygame.display.get_surface().get_size() == (60, 40)
    assert pygame.display.get_surface().get_at((20, 10))[:3] == (1, 2, 3)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    window.show(picture)
    assert not pygame.display.get_init()
    window.show(picture)
    window.close()


@pytest.mark.filterwarnings("error")
@pytest.mark.usefixtures("pygame")
def test_gymnasiums_own_check_opens_the_window_too():
    env = gymnasium.make(ID, decision_period_s=0.1, render_mode="human")
    check_env(env.unwrapped)
    env.close()
    assert "human" in env.metadata["render_modes"]


def test_without_a_display_the_window_is_refused_in_a_sentence(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with user_error(r"render_mode=human: needs pygame .* and a display"):
        make(render_mode="human")
    assert make().unwrapped.metadata["render_modes"] == ["rgb_array", "rgb_array_list"]
