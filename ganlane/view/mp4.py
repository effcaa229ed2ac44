"""Films as mp4: H.264 through the ffmpeg that imageio-ffmpeg brings along."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.view.gif import scaled

Picture = npt.NDArray[np.uint8]
_ENCODING = "-an -c:v libx264 -pix_fmt yuv420p -crf 20 -preset medium -movflags +faststart -f mp4"


def write_mp4(frames: Sequence[Picture], path: str | Path, fps: float, scale: float) -> None:
    """Write a film, whole or not at all.

    Raises:
        UserError: the extra ``video`` is missing, or ffmpeg refuses.
        OSError: the file cannot be written.
    """
    ffmpeg = _ffmpeg(path)
    # H.264 wants even sides.
    width, height = scaled(frames[0], scale, multiple=2).size
    rate = Fraction(fps).limit_denominator()
    raw = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate} -i -"
    with atomic_path(path) as part:
        line = [ffmpeg, "-y", "-v", "error", *raw.split(), *_ENCODING.split(), str(part)]
        refusal = _run(line, (scaled(picture, scale, multiple=2).tobytes() for picture in frames))
        if refusal is not None:
            raise UserError(f"{path}: ffmpeg cannot write it ({refusal}); choose format=gif.")


def _ffmpeg(path: str | Path) -> str:
    """The program's path."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:  # not installed, or without a program for this machine
        raise UserError(
            f"{path}: mp4 needs the extra 'video'; run `pip install \"ganlane[video]\"` or choose format=gif."
        ) from error


def _run(line: Sequence[str], pictures: Iterable[bytes]) -> str | None:
    """Feed ``pictures`` to a program; what it says where it fails.

    imageio-ffmpeg's own writer does not look at the exit status: on a full disk it takes half a film for a whole one.
    """
    # In a session of its own, so that Ctrl-C reaches this process alone, which then ends the other.
    pipe = subprocess.PIPE
    program = subprocess.Popen(line, stdin=pipe, stderr=pipe, stdout=subprocess.DEVNULL, start_new_session=True)
    assert program.stdin is not None
    try:
        for picture in pictures:
            program.stdin.write(picture)
    except BrokenPipeError:
        pass  # It has ended early, and says why.
    except BaseException:
        program.kill()
        program.communicate()
        raise
    _, said = program.communicate()
    if program.returncode == 0:
        return None
    lines = said.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"status {program.returncode}"
