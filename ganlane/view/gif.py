"""GIF with one palette for the whole film, made to fit a size."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from ganlane.errors import UserError
from ganlane.files import write_bytes

Picture = npt.NDArray[np.uint8]
#: Frames from which the palette is taken.
_PALETTE_FRAMES = 8
#: Colours of large flat areas, which are kept as they are.
_FLAT_COLOURS = 8


@dataclass(frozen=True)
class Thrift:
    """What is given up for a smaller file."""

    #: Share of the picture's size.
    size: float
    #: Every so many frames one is kept.
    every: int
    colours: int


#: What is tried in turn to make a film fit.
_ATTEMPTS = (
    Thrift(1.0, 1, 128),
    Thrift(0.85, 1, 96),
    Thrift(0.75, 1, 64),
    Thrift(0.75, 2, 64),
    Thrift(0.6, 2, 64),
    Thrift(0.5, 2, 48),
    Thrift(0.5, 3, 32),
    Thrift(0.4, 4, 32),
)


def scaled(picture: Picture, scale: float, multiple: int = 1) -> Image.Image:
    """The picture at ``scale``, its sides a multiple of so many pixels."""
    image = Image.fromarray(picture)
    width, height = (max(multiple, round(side * scale / multiple) * multiple) for side in image.size)
    same = (width, height) == image.size
    return image if same else image.resize((width, height), Image.Resampling.LANCZOS, reducing_gap=2.0)


def write_gif(
    frames: Sequence[Picture], path: str | Path, fps: float, max_bytes: int | None = None, scale: float = 1.0
) -> None:
    """Write an endless GIF; with ``max_bytes`` its size, frame rate and colours are lowered until it fits.

    Raises:
        UserError: even the smallest attempt is larger than ``max_bytes``.
    """
    content = b""
    for thrift in _ATTEMPTS:
        content = encode_gif(frames, fps, Thrift(scale * thrift.size, thrift.every, thrift.colours))
        if max_bytes is None or len(content) <= max_bytes:
            write_bytes(path, content)
            return
    raise UserError(
        f"{path}: the smallest GIF has {len(content)} bytes, max_bytes={max_bytes} were allowed; "
        "show a shorter part of the episode or allow more."
    )


def encode_gif(frames: Sequence[Picture], fps: float, thrift: Thrift) -> bytes:
    """The GIF's bytes."""
    palette = _shared_palette(frames, thrift)
    pictures = [
        scaled(frames[index], thrift.size).quantize(palette=palette, dither=Image.Dither.NONE)
        for index in range(0, len(frames), thrift.every)
    ]
    file = io.BytesIO()
    pictures[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=_durations(len(pictures), fps / thrift.every),
        loop=0,
        optimize=False,
        disposal=1,
    )
    return file.getvalue()


def _shared_palette(frames: Sequence[Picture], thrift: Thrift) -> Image.Image:
    """A palette image for all frames, from some of them: the commonest colours as they are, the others covered.

    Without the former, large flat areas would change their colour a little; without the latter, small
    bright things would lose theirs.
    """
    chosen = np.linspace(0, len(frames) - 1, min(_PALETTE_FRAMES, len(frames))).round()
    stack = np.concatenate([np.asarray(scaled(frames[int(index)], thrift.size)) for index in chosen])
    exact = _commonest(stack, _FLAT_COLOURS)
    covering = Image.fromarray(stack).quantize(thrift.colours - len(exact), method=Image.Quantize.MAXCOVERAGE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*exact.ravel().tolist(), *(covering.getpalette() or [])])
    return palette


def _commonest(picture: Picture, count: int) -> Picture:
    """The most frequent colours, [up to ``count``, 3]."""
    packed = picture.reshape(-1, 3).astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    values, counts = np.unique(packed, return_counts=True)
    top = values[np.argsort(-counts, kind="stable")[:count]]
    return np.stack([top >> 16, (top >> 8) & 255, top & 255], axis=1).astype(np.uint8)


def _durations(count: int, fps: float) -> list[int]:
    """Milliseconds of each frame; whole hundredths of a second that add up to the film's length."""
    ends = np.rint(np.arange(count + 1) * 100.0 / fps).astype(int)
    return (np.diff(ends).clip(min=2) * 10).tolist()
