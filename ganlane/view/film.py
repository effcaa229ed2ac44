"""Films as mp4 or GIF, and film strips as PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from subprocess import PIPE, Popen

import numpy as np
from PIL import Image

from ganlane.errors import UserError
from ganlane.files import atomic_path, write_bytes
from ganlane.settings.render import FilmConfig
from ganlane.view.frames import FramePainter
from ganlane.view.record import Trajectory

#: Frames of a film strip, as in the paper's Figure 3.
STRIP_FRAMES = 4
#: How long the last frame stays, s of film.
HOLD_S = 1.5
#: What ffmpeg makes of the pictures. H.264 takes even sides only.
_H264 = (
    "-an -vf crop=trunc(iw/2)*2:trunc(ih/2)*2 -c:v libx264 -pix_fmt yuv420p -crf 20 "
    "-preset medium -movflags +faststart -f mp4"
)
#: Number of colours of a GIF.
_COLOURS = 128
#: Number of frames that they are taken from.
_PALETTE_FRAMES = 8


def film_frames(trajectory: Trajectory, look: FilmConfig) -> list[int]:
    """Frames of the trajectory, in the order in which a film shows them.

    The film is ``look.speedup`` times as fast as the episode; its last frame stays for
    :data:`HOLD_S`.

    Raises:
        UserError: the film begins after the episode's end.
    """
    # Refused here where the episode is over by then.
    trajectory.since(look.start_s)
    time = trajectory.time_s
    end = min(look.end_s or np.inf, float(time[-1]))
    # 1e-9 s, so that rounding does not lose the last frame.
    times = np.arange(look.start_s, end + 1e-9, look.speedup / look.fps)
    # At every time of the film the last recorded frame is shown.
    shown = np.searchsorted(time, [*times + 1e-9, end + 1e-9], side="right") - 1
    *frames, last = shown.tolist()
    hold = max(1, round(HOLD_S * look.fps))
    return frames + [last] * hold


def write_film(trajectory: Trajectory, path: str | Path, look: FilmConfig | None = None) -> Path:
    """Write an episode's film, whole or not at all, and return its path.

    Args:
        trajectory: the recorded episode.
        path: where to write: ``.mp4`` (needs the extra ``video``), ``.gif``, or ``.png``, a strip
            of four frames.
        look: part of the episode, speed and size. A GIF counts in hundredths of a second, so 10,
            20, 25 and 50 frames per second are exact.

    Raises:
        UserError: unknown format, the film begins after the episode's end, or the extra ``video``
            is missing.
    """
    path = Path(path)
    kind = path.suffix.removeprefix(".").lower()
    look = look or FilmConfig()
    painter = FramePainter(trajectory, look)
    frames = film_frames(trajectory, look)

    if kind == "gif":
        write_bytes(path, _gif(painter, frames))
    elif kind == "mp4":
        _write_mp4(painter, frames, path)
    elif kind == "png":
        # One below the other.
        rows = [painter.draw(frame) for frame in spread(frames, STRIP_FRAMES)]
        strip = Image.fromarray(np.concatenate(rows))
        with atomic_path(path) as part:
            strip.save(part, format="PNG", optimize=True)
    else:
        raise UserError(f"{path}: a film ends in .mp4, .gif or .png; choose one of them.")
    return path


def spread(frames: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the frames, evenly from the first to the last."""
    count = min(count, len(frames))
    places = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return [frames[place] for place in places]


def _gif(painter: FramePainter, frames: Sequence[int]) -> bytes:
    """An endless GIF with one palette for the whole film."""
    # The commonest colours would leave out small bright things, such as lights.
    some = np.concatenate([painter.draw(frame) for frame in spread(frames, _PALETTE_FRAMES)])
    palette = Image.fromarray(some).quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)
    pictures = []
    for frame in frames:
        picture = Image.fromarray(painter.draw(frame))
        # Without dither, which would make still things shimmer.
        pictures.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))

    # Whole hundredths of a second that add up to the film's length.
    ends = np.rint(np.arange(len(pictures) + 1) * 100.0 / painter.look.fps).astype(int)
    # Two hundredths at least: players slow down what is faster.
    durations_ms = (np.diff(ends).clip(min=2) * 10).tolist()

    file = io.BytesIO()
    pictures[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=durations_ms,
        loop=0,
        optimize=False,
        disposal=1,
    )
    return file.getvalue()


def _write_mp4(painter: FramePainter, frames: Sequence[int], path: Path) -> None:
    """H.264 through the ffmpeg that imageio-ffmpeg brings along.

    imageio-ffmpeg's own writer ignores the exit status: on a full disk it takes half a film for a
    whole one.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # an extra

        ffmpeg = get_ffmpeg_exe()
    # not installed, or without a program for this machine
    except (ImportError, RuntimeError) as error:
        raise UserError(
            f"{path}: mp4 needs the extra 'video'; run `pip install \"ganlane[video]\"` or choose "
            "a gif."
        ) from error

    look = painter.look
    # Exact, as a fraction.
    rate = Fraction(look.fps).limit_denominator()
    # Pictures come as plain bytes through its standard input.
    raw = f"-f rawvideo -pix_fmt rgb24 -s {look.width}x{look.height} -r {rate} -i -"
    options = f"-y -v error {raw} {_H264}".split()
    with atomic_path(path) as part:
        words = [ffmpeg, *options, str(part)]
        # In a session of its own, so that Ctrl-C reaches this process alone. ffmpeg ends with its
        # input.
        with Popen(words, stdin=PIPE, stderr=PIPE, start_new_session=True) as program:
            assert program.stdin is not None
            try:
                for frame in frames:
                    program.stdin.write(painter.draw(frame).tobytes())
            except BrokenPipeError:
                pass  # It has ended early; its error message follows.
            _, message = program.communicate()
        if program.returncode != 0:
            lines = message.decode(errors="replace").strip().splitlines()
            reason = lines[-1] if lines else f"status {program.returncode}"
            raise UserError(f"{path}: ffmpeg cannot write it ({reason}); choose a gif.")
