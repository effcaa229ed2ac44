"""Films as mp4 or GIF, and film strips as PNG."""

from __future__ import annotations

import io
import subprocess
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from PIL import Image

from ganlane.errors import UserError
from ganlane.files import atomic_path, write_bytes
from ganlane.view.frames import FramePainter, Picture

Format = Literal["mp4", "gif", "png"]
#: Frames of a film strip, as in the paper's Figure 3.
STRIP_FRAMES = 4
_H264 = "-an -c:v libx264 -pix_fmt yuv420p -crf 20 -preset medium -movflags +faststart -f mp4"
#: Frames from which a GIF's palette is taken, and colours of large flat areas, which are kept as
#: they are.
_PALETTE_FRAMES, _FLAT_COLOURS = 8, 8
#: Tried in turn to make a GIF fit: share of the picture's size, colours, and every how many frames
#: one is kept.
_GIF_SIZES = (
    *((1.0, 128, 1), (0.85, 96, 1), (0.75, 64, 1)),
    *((0.75, 64, 2), (0.6, 64, 2), (0.5, 48, 2), (0.5, 32, 3), (0.4, 32, 4)),
)


class Film:
    """The frames of a film, each drawn when it is asked for, so that long films need no memory.

    Args:
        painter: draws the frames.
        fps: frames per second of the film.
        speedup: simulated seconds per second of film.
        start_s, end_s: part of the episode, s; None for its end.
        hold_s: how long the last frame stays, s of film.

    Raises:
        UserError: the part of the episode is empty, or ``fps`` or ``speedup`` is not above 0.
    """

    def __init__(
        self,
        painter: FramePainter,
        fps: float = 20.0,
        speedup: float = 1.0,
        start_s: float = 0.0,
        end_s: float | None = None,
        hold_s: float = 1.5,
    ):
        if not (fps > 0 and speedup > 0):
            raise UserError(f"film with fps={fps:g}, speedup={speedup:g}: both must be above 0.")
        time = painter.trajectory.time_s
        end = float(time[-1]) if end_s is None else min(end_s, float(time[-1]))
        if not 0 <= start_s <= end:
            raise UserError(
                f"film from {start_s:g} to {end:g} s: the episode lasts {time[-1]:g} s; choose a part of it."
            )
        self.painter = painter
        last = int(np.searchsorted(time, end + 1e-9, side="right") - 1)
        wanted = np.arange(start_s, end + 1e-9, speedup / fps)
        shown = np.searchsorted(time, wanted + 1e-9, side="right") - 1
        self._frames: list[int] = [
            *shown.clip(0, last).tolist(),
            *[last] * max(1, round(hold_s * fps)),
        ]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Picture:
        return self.painter.draw(self._frames[index])


def film_format(path: str | Path, wanted: str | None = None) -> Format:
    """The format that is ``wanted``, or else the one of the file's ending.

    Raises:
        UserError: it is none of mp4, gif and png.
    """
    name: Any = (wanted or Path(path).suffix.removeprefix(".")).lower()
    if name not in get_args(Format):
        raise UserError(f"format={name or 'none'}: expected mp4, gif or png; choose one of them.")
    return name


def write_film(
    frames: Film | Sequence[Picture],
    path: str | Path,
    fps: float = 20.0,
    format: Format | None = None,
    max_bytes: int | None = None,
    scale: float = 1.0,
) -> Path:
    """Write a film, whole or not at all, and return its path.

    Args:
        frames: pictures [height, width, 3] uint8, all of one size; no more than a few are held at
            once.
        path: where to write.
        fps: frames per second; a GIF counts in hundredths of a second, so 10, 20, 25 and 50 are
            exact.
        format: ``mp4`` (needs the extra ``video``), ``gif`` or ``png`` (a strip of four frames,
            stacked); by default the file's ending.
        max_bytes: for a GIF: size, frame rate and colours are lowered until it fits.
        scale: size of the film's picture, as a share of the frames'.

    Raises:
        UserError: unknown format, no frames, the extra ``video`` is missing, or no GIF is small
            enough.
    """
    kind = film_format(path, format)
    if len(frames) == 0:
        raise UserError(f"{path}: a film of no frames was asked for; record at least one decision.")
    if kind == "gif":
        for size, colours, every in _GIF_SIZES:
            content = _encode_gif(frames, fps, scale * size, colours, every)
            if max_bytes is None or len(content) <= max_bytes:
                write_bytes(path, content)
                return Path(path)
        raise UserError(
            f"{path}: the smallest GIF has {len(content)} bytes, max_bytes={max_bytes} were allowed; "
            "show a shorter part of the episode or allow more."
        )
    if kind == "mp4":
        _write_mp4(frames, path, fps, scale)
    else:
        with atomic_path(path) as part:
            _scaled(film_strip(frames), scale).save(part, format="PNG", optimize=True)
    return Path(path)


def film_strip(frames: Film | Sequence[Picture], count: int = STRIP_FRAMES) -> Picture:
    """``count`` frames, spread evenly from the first to the last, one below the other."""
    chosen = [frames[index] for index in _spread(len(frames), count)]
    gap = np.full((4, chosen[0].shape[1], 3), 255, np.uint8)
    rows = [row for picture in chosen for row in (picture, gap)]
    return np.concatenate(rows[:-1])


def _spread(length: int, count: int) -> list[int]:
    """At most ``count`` indices from the first to the last of ``length``."""
    return np.linspace(0, length - 1, min(count, length)).round().astype(int).tolist()


def _scaled(picture: Picture, scale: float, multiple: int = 1) -> Image.Image:
    """The picture at ``scale``, its sides a multiple of so many pixels."""
    image = Image.fromarray(picture)
    width, height = (
        max(multiple, round(side * scale / multiple) * multiple) for side in image.size
    )
    same = (width, height) == image.size
    return (
        image if same else image.resize((width, height), Image.Resampling.LANCZOS, reducing_gap=2.0)
    )


def _encode_gif(
    frames: Film | Sequence[Picture], fps: float, scale: float, colours: int, every: int
) -> bytes:
    """An endless GIF with one palette for the whole film."""
    palette = _shared_palette(frames, scale, colours)
    pictures = [
        _scaled(frames[index], scale).quantize(palette=palette, dither=Image.Dither.NONE)
        for index in range(0, len(frames), every)
    ]
    # Whole hundredths of a second that add up to the film's length.
    ends = np.rint(np.arange(len(pictures) + 1) * 100.0 / (fps / every)).astype(int)
    durations_ms = (np.diff(ends).clip(min=2) * 10).tolist()
    file = io.BytesIO()
    options: dict[str, Any] = {
        "duration": durations_ms,
        "loop": 0,
        "optimize": False,
        "disposal": 1,
    }
    pictures[0].save(file, format="GIF", save_all=True, append_images=pictures[1:], **options)
    return file.getvalue()


def _shared_palette(frames: Film | Sequence[Picture], scale: float, colours: int) -> Image.Image:
    """A palette image for all frames, from some of them: the commonest colours as they are, the
    others covered.

    Without the former, large flat areas would change their colour a little; without the latter,
    small bright things would lose theirs.
    """
    chosen = _spread(len(frames), _PALETTE_FRAMES)
    stack = np.concatenate([np.asarray(_scaled(frames[index], scale)) for index in chosen])
    packed = stack.reshape(-1, 3).astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    values, counts = np.unique(packed, return_counts=True)
    top = values[np.argsort(-counts, kind="stable")[:_FLAT_COLOURS]]
    exact = np.stack([top >> 16, (top >> 8) & 255, top & 255], axis=1)
    covering = Image.fromarray(stack).quantize(
        colours - len(exact), method=Image.Quantize.MAXCOVERAGE
    )
    palette = Image.new("P", (1, 1))
    palette.putpalette([*exact.ravel().tolist(), *(covering.getpalette() or [])])
    return palette


def _write_mp4(
    frames: Film | Sequence[Picture], path: str | Path, fps: float, scale: float
) -> None:
    """H.264 through the ffmpeg that imageio-ffmpeg brings along."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # an extra

        ffmpeg = get_ffmpeg_exe()
    # not installed, or without a program for this machine
    except (ImportError, RuntimeError) as error:
        raise UserError(
            f"{path}: mp4 needs the extra 'video'; run `pip install \"ganlane[video]\"` or choose format=gif."
        ) from error
    width, height = _scaled(frames[0], scale, multiple=2).size  # H.264 takes even sides only
    rate = Fraction(fps).limit_denominator()
    raw = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate} -i -"
    with atomic_path(path) as part:
        line = [ffmpeg, "-y", "-v", "error", *raw.split(), *_H264.split(), str(part)]
        pictures = (
            _scaled(frames[index], scale, multiple=2).tobytes() for index in range(len(frames))
        )
        failure = _run_with_input(line, pictures)
        if failure is not None:
            raise UserError(f"{path}: ffmpeg cannot write it ({failure}); choose format=gif.")


def _run_with_input(line: Sequence[str], pictures: Iterable[bytes]) -> str | None:
    """Feed ``pictures`` to a program; its error message if it fails.

    imageio-ffmpeg's own writer ignores the exit status: on a full disk it takes half a film for a
    whole one.
    """
    # In a session of its own, so that Ctrl-C reaches this process alone, which then ends the other.
    pipe = subprocess.PIPE
    program = subprocess.Popen(
        line, stdin=pipe, stderr=pipe, stdout=subprocess.DEVNULL, start_new_session=True
    )
    assert program.stdin is not None
    try:
        for picture in pictures:
            program.stdin.write(picture)
    except BrokenPipeError:
        pass  # It has ended early; its error message follows.
    except BaseException:
        program.kill()
        program.communicate()
        raise
    _, message = program.communicate()
    if program.returncode == 0:
        return None
    lines = message.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"status {program.returncode}"
