"""Films have the frames and the size that were asked for, and are whole or absent."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
import pytest
from PIL import Image, ImageSequence
from view_scenes import straight

from ganlane.errors import UserError
from ganlane.view import Film, FramePainter, film_strip, write_film
from ganlane.view import film as film_module


@pytest.fixture(scope="module")
def film():
    return Film(FramePainter(straight([0, 30, -20], [1, 2, 0], frames=41)), fps=10, hold_s=0.5)


def first(film, count):
    return [film[index] for index in range(count)]


def at_half_size(picture):
    return np.asarray(Image.fromarray(picture).resize((640, 160), Image.Resampling.LANCZOS)).astype(
        int
    )


def test_a_film_lasts_as_long_as_the_episode_and_holds_its_end(film):
    assert len(film) == 41 + 5
    assert np.array_equal(film[-1], film[40])
    assert not np.array_equal(film[0], film[1])
    assert len(list(film)) == len(film)


def test_speedup_and_part_choose_frames_by_time():
    painter = FramePainter(straight([0], [1], frames=101))
    assert Film(painter, 10, 2.0, start_s=2.0, end_s=6.0, hold_s=0.1)._frames == [
        *range(20, 61, 2),
        60,
    ]
    assert Film(painter, 20, end_s=0.3, hold_s=0.05)._frames == [0, 0, 1, 1, 2, 2, 3, 3]


def test_impossible_and_empty_films_and_unknown_formats_are_refused(tmp_path):
    painter = FramePainter(straight([0], [1]))
    for part in ({"start_s": 9.0}, {"start_s": 2.0, "end_s": 1.0}, {"fps": 0}, {"speedup": -1}):
        with pytest.raises(UserError, match="film"):
            Film(painter, **part)
    with pytest.raises(UserError, match="avi"):
        write_film(Film(painter), tmp_path / "a.avi")
    with pytest.raises(UserError, match="no frames"):
        write_film([], tmp_path / "a.gif")


def test_a_gif_comes_back_frame_by_frame(film, tmp_path):
    path = write_film(film, tmp_path / "a.gif", fps=10, scale=0.5)
    with Image.open(path) as gif:
        assert gif.size == (640, 160)
        # Equal frames at the end are stored as one that lasts longer.
        assert sum(frame.info["duration"] for frame in ImageSequence.Iterator(gif)) == 100 * len(
            film
        )
        assert gif.info["loop"] == 0
        gif.seek(20)
        shown = np.asarray(gif.convert("RGB")).astype(int)
    assert np.abs(shown - at_half_size(film[20])).mean() < 3.0


def test_a_gif_is_made_to_fit(film, tmp_path):
    part = first(film, 9)
    free = write_film(part, tmp_path / "free.gif", fps=10, scale=0.5).stat().st_size
    bound = write_film(part, tmp_path / "bound.gif", fps=10, scale=0.5, max_bytes=free // 3)
    assert bound.stat().st_size <= free // 3
    with pytest.raises(UserError, match="max_bytes"):
        write_film(part, tmp_path / "none.gif", fps=10, scale=0.5, max_bytes=100)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bound.gif", "free.gif"]


def test_a_strip_stacks_four_frames(film, tmp_path):
    path = write_film(film, tmp_path / "strip.png")
    with Image.open(path) as strip:
        assert strip.size == (1280, 4 * 320 + 3 * 4)
        pixels = np.asarray(strip.convert("RGB"))
    assert np.array_equal(pixels[:320], film[0])
    assert np.array_equal(pixels[-320:], film[-1])
    assert film_strip(first(film, 2)).shape == (2 * 320 + 4, 1280, 3)


def test_an_mp4_has_all_frames(film, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = write_film(first(film, 10), tmp_path / "a.mp4", fps=10, scale=0.5)
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    assert meta["size"] == (640, 160)
    assert meta["fps"] == 10
    frames = list(reader)
    assert len(frames) == 10
    shown = np.frombuffer(frames[3], np.uint8).reshape(160, 640, 3).astype(int)
    assert np.abs(shown - at_half_size(film[3])).mean() < 6.0


@pytest.fixture
def empty(tmp_path):
    """A folder that the test leaves empty."""
    yield tmp_path
    assert not list(tmp_path.iterdir())


def test_half_an_mp4_on_a_full_disk_is_none(film, empty):
    """ffmpeg fails, and only its exit status says so."""
    pytest.importorskip("imageio_ffmpeg")
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**12, before[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            write_film(first(film, 10), empty / "a.mp4", fps=10, scale=0.5)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(empty / "a.mp4")


def test_an_ffmpeg_that_refuses_is_quoted(film, empty, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(film_module, "_H264", "-c:v no_such_codec -f mp4")
    with pytest.raises(UserError, match=r"a\.mp4: ffmpeg cannot write it \(.*choose format=gif"):
        write_film(first(film, 2), empty / "a.mp4", fps=10)


def test_without_the_extra_video_the_message_names_it(film, empty, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"ganlane\[video\]"):
        write_film(film, empty / "a.mp4")


def test_a_failure_half_way_leaves_nothing(film, empty):
    class Broken(list):
        def __getitem__(self, index):
            if index == 3:
                raise RuntimeError("no")
            return film[0]

    for name in ["a.gif", "a.mp4"] if find_spec("imageio_ffmpeg") else ["a.gif"]:
        with pytest.raises(RuntimeError):
            write_film(Broken([0] * 6), empty / name, scale=0.25)
