"""Films as mp4 or GIF, and film strips as PNG."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, get_args, overload

import numpy as np
import numpy.typing as npt

from ganlane.errors import UserError
from ganlane.files import atomic_path
from ganlane.view.frames import FramePainter
from ganlane.view.gif import scaled, write_gif
from ganlane.view.mp4 import write_mp4

Picture = npt.NDArray[np.uint8]
Format = Literal["mp4", "gif", "png"]
#: Frames of a film strip, as in the paper's Figure 3.
STRIP_FRAMES = 4
_STRIP_GAP = 4


class Film(Sequence[Picture]):
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
        self.painter, self.fps = painter, fps
        last = int(np.searchsorted(time, end + 1e-9, side="right") - 1)
        wanted = np.arange(start_s, end + 1e-9, speedup / fps)
        shown = np.searchsorted(time, wanted + 1e-9, side="right") - 1
        self._frames: list[int] = [*shown.clip(0, last).tolist(), *[last] * max(1, round(hold_s * fps))]

    def __len__(self) -> int:
        """Number of frames of the film."""
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> Picture: ...
    @overload
    def __getitem__(self, index: slice) -> list[Picture]: ...
    def __getitem__(self, index: int | slice) -> Picture | list[Picture]:
        """Draw one frame, or a list of them."""
        if isinstance(index, slice):
            return [self.painter.draw(frame) for frame in self._frames[index]]
        return self.painter.draw(self._frames[index])

    def __iter__(self) -> Iterator[Picture]:
        """Draw all frames, one after the other."""
        return (self.painter.draw(frame) for frame in self._frames)


def film_format(path: str | Path, wanted: str | None = None) -> Format:
    """The format that is ``wanted``, or else the one of the file's ending.

    Raises:
        UserError: it is none of mp4, gif and png.
    """
    name = (wanted or Path(path).suffix.removeprefix(".")).lower()
    for known in get_args(Format):
        if name == known:
            return known
    raise UserError(f"format={name or 'none'}: expected mp4, gif or png; choose one of them.")


def write_film(
    frames: Sequence[Picture],
    path: str | Path,
    fps: float = 20.0,
    format: Format | None = None,
    max_bytes: int | None = None,
    scale: float = 1.0,
) -> Path:
    """Write a film, whole or not at all, and return its path.

    Args:
        frames: pictures [height, width, 3] uint8, all of one size; may be drawn on demand
            (:class:`ganlane.view.Film`), since no more than a few are held at once.
        path: where to write.
        fps: frames per second; a GIF counts in hundredths of a second, so 10, 20, 25 and 50 are exact.
        format: ``mp4`` (needs the extra ``video``), ``gif`` or ``png`` (a strip of four frames, stacked);
            by default the file's ending.
        max_bytes: for a GIF: size and frame rate are lowered until it fits.
        scale: size of the film's picture, as a share of the frames'.

    Raises:
        UserError: unknown format, no frames, the extra ``video`` is missing, or no GIF is small enough.
    """
    kind = film_format(path, format)
    if len(frames) == 0:
        raise UserError(f"{path}: a film of no frames was asked for; record at least one decision.")
    if kind == "gif":
        write_gif(frames, path, fps, max_bytes, scale)
    elif kind == "mp4":
        write_mp4(frames, path, fps, scale)
    else:
        _write_png(film_strip(frames), path, scale)
    return Path(path)


def film_strip(frames: Sequence[Picture], count: int = STRIP_FRAMES) -> Picture:
    """``count`` frames, spread evenly from the first to the last, one below the other."""
    chosen = [frames[int(index)] for index in np.linspace(0, len(frames) - 1, min(count, len(frames))).round()]
    gap = np.full((_STRIP_GAP, chosen[0].shape[1], 3), 255, np.uint8)
    rows = [row for picture in chosen for row in (picture, gap)]
    return np.concatenate(rows[:-1])


def _write_png(picture: Picture, path: str | Path, scale: float) -> None:
    with atomic_path(path) as part:
        scaled(picture, scale).save(part, format="PNG", optimize=True)
