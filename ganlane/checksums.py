"""A checksum inside each file that is written and read back, so that damage to any byte is detected.

:data:`PLACE` occurs once in the content, wherever the format has room for text: metadata, an entry, an archive's
comment. Its digits are the SHA-256 of the whole content with zeros in their place. This protects against damage, not
against forgery: anyone can compute a new checksum for a changed file.
"""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from mmap import mmap
from pathlib import Path

from ganlane.errors import UserError

_BEGIN, _END = b"ganlane sha256 ", b" of this file"
_ZEROS = b"0" * 64
#: Placeholder in the content until :func:`sealed` puts the checksum in.
PLACE = (_BEGIN + _ZEROS + _END).decode()
#: The end of a zip archive: its comment's length, its comment.
_COMMENT = len(PLACE).to_bytes(2, "little") + PLACE.encode()


def sealed(content: bytes) -> bytes:
    """``content``, which holds :data:`PLACE`, with its checksum."""
    begin = content.index(PLACE.encode()) + len(_BEGIN)
    return content[:begin] + _digits(content, begin) + content[begin + len(_ZEROS) :]


def sealed_archive(content: bytes) -> bytes:
    """A zip archive without a comment (.npz, .pt) with its checksum as comment."""
    return sealed(content[:-2] + _COMMENT)


def seal_archive(path: Path) -> None:
    """:func:`sealed_archive` in place, for files too large to be held in memory."""
    with path.open("rb+") as file:
        file.seek(-2, 2)
        file.write(_COMMENT)
        file.flush()
        with mmap(file.fileno(), 0) as content:
            begin = len(content) - len(PLACE) + len(_BEGIN)
            content[begin : begin + len(_ZEROS)] = _digits(content, begin)


def has_checksum(content: bytes | mmap, path: str | Path) -> bool:
    """Whether ``content`` has a checksum; files of ganlane 0.2 and before have none.

    Raises:
        UserError: it has one that does not match; ``path`` is named as the damaged file.
    """
    begin, end = content.find(_BEGIN), content.find(_END)
    if begin < 0 and end < 0:
        return False
    begin += len(_BEGIN)
    if end != begin + len(_ZEROS) or content[begin:end] != _digits(content, begin):
        raise UserError(
            f"{path}: damaged, its content does not have the checksum that was written with it; take a copy that is "
            "whole, or make it again."
        )
    return True


def _digits(content: bytes | mmap, begin: int) -> bytes:
    """Checksum of ``content`` with zeros in the place of the digits at ``begin``."""
    view, digest = memoryview(content), hashlib.sha256()
    for part in (view[:begin], _ZEROS, view[begin + len(_ZEROS) :]):
        digest.update(part)
    return digest.hexdigest().encode()


@cache
def note_without_checksum(path: str | Path) -> None:
    """Warn once per file that a version without checksums wrote it."""
    print(f"{path}: of a version that wrote no checksum; damage to it would not be seen.", file=sys.stderr)
