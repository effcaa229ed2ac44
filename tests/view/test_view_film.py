"""Films have the frames and the size that were asked for, and are whole or absent."""

import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from PIL import Image, ImageSequence
from reference.refusals import user_error
from view_scenes import straight

from ganlane.settings.render import FilmConfig
from ganlane.view import FramePainter, write_film
from ganlane.view import film as film_module
from ganlane.view.film import film_frames, spread

#: A second of film, and its last frame for 1.5 s.
SMALL = FilmConfig(fps=10, width=640, height=160)
SHORT = replace(SMALL, end_s=0.9)
needs_video = pytest.mark.skipif(
    find_spec("imageio_ffmpeg") is None, reason="the extra video is not installed"
)


@pytest.fixture(scope="module")
def episode():
    return straight([0, 30, -20], [1, 2, 0], frames=41)


def frame(episode, number, look=None):
    """A frame's pixels."""
    return FramePainter(episode, look).draw(number).astype(int)


def test_speedup_and_part_choose_frames_by_time_and_the_last_one_is_held():
    episode = straight([0], [1], frames=101)
    fast = film_frames(episode, FilmConfig(fps=10, speedup=2.0, start_s=2.0, end_s=6.0))
    assert fast == [*range(20, 61, 2)] + [60] * 15
    assert film_frames(episode, FilmConfig(end_s=0.3)) == [0, 0, 1, 1, 2, 2, 3] + [3] * 30
    assert film_frames(episode, FilmConfig(fps=10)) == [*range(101)] + [100] * 15


def test_films_of_nothing_and_unknown_formats_are_refused(episode, tmp_path):
    with user_error("start at 9 s: the episode lasts 4 s"):
        write_film(episode, tmp_path / "a.gif", FilmConfig(start_s=9.0))
    with user_error("avi"):
        write_film(episode, tmp_path / "a.avi")


def test_a_gif_comes_back_frame_by_frame(episode, tmp_path):
    path = write_film(episode, tmp_path / "a.gif", SMALL)
    with Image.open(path) as gif:
        assert gif.size == (640, 160)
        # Equal frames at the end are stored as one that lasts longer.
        times = [picture.info["duration"] for picture in ImageSequence.Iterator(gif)]
        assert sum(times) == 100 * (41 + 15)
        assert gif.info["loop"] == 0
        gif.seek(20)
        shown = np.asarray(gif.convert("RGB")).astype(int)
    assert np.abs(shown - frame(episode, 20, SMALL)).mean() < 3.0


def test_a_strip_stacks_four_frames(episode, tmp_path):
    path = write_film(episode, tmp_path / "strip.png")
    with Image.open(path) as strip:
        assert strip.size == (1280, 4 * 320)
        pixels = np.asarray(strip.convert("RGB"))
    assert np.array_equal(pixels[:320], frame(episode, 0))
    assert np.array_equal(pixels[-320:], frame(episode, 40))
    assert spread([5, 6], 4) == [5, 6]


@needs_video
def test_an_mp4_has_all_frames(episode, tmp_path):
    import imageio_ffmpeg

    path = write_film(episode, tmp_path / "a.mp4", SHORT)
    meta, *frames = imageio_ffmpeg.read_frames(str(path))
    assert (meta["size"], meta["fps"], len(frames)) == ((640, 160), 10, 10 + 15)
    shown = np.frombuffer(frames[3], np.uint8).reshape(160, 640, 3).astype(int)
    assert np.abs(shown - frame(episode, 3, SHORT)).mean() < 6.0


@pytest.fixture
def empty(tmp_path):
    """A folder that the test leaves empty."""
    yield tmp_path
    assert not list(tmp_path.iterdir())


@needs_video
def test_half_an_mp4_on_a_full_disk_is_none(episode, empty, room_on_disk):
    """ffmpeg fails, and only its exit status says so."""
    room_on_disk(2**12)
    with pytest.raises(OSError, match="File too large") as caught:
        write_film(episode, empty / "a.mp4", SHORT)
    assert caught.value.filename == str(empty / "a.mp4")


@needs_video
def test_an_ffmpeg_that_refuses_is_quoted(episode, empty, monkeypatch):
    monkeypatch.setattr(film_module, "_H264", "-c:v no_such_codec -f mp4")
    with user_error(r"a\.mp4: ffmpeg cannot write it \(.*choose a gif"):
        write_film(episode, empty / "a.mp4", SHORT)


def test_without_the_extra_video_the_message_names_it(episode, empty, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with user_error(r"ganlane\[video\]"):
        write_film(episode, empty / "a.mp4")


@pytest.mark.parametrize("ending", ["gif", pytest.param("mp4", marks=needs_video)])
def test_a_failure_half_way_leaves_nothing(episode, empty, ending, monkeypatch):
    draw = FramePainter.draw

    def broken(painter, number):
        if number == 3:
            raise RuntimeError("no")
        return draw(painter, number)

    monkeypatch.setattr(FramePainter, "draw", broken)
    with pytest.raises(RuntimeError):
        write_film(episode, empty / f"a.{ending}", SHORT)
