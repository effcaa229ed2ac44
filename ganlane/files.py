"""Files: the package's own folders, atomic writes and checksums.

Files that are written and read back hold a checksum of their own, so that damage to any byte is
detected. :data:`PLACE` occurs once in the content, wherever the format has room for text: metadata,
an entry, an archive's comment. Its digits are the SHA-256 of the whole content with zeros in their
place. This protects against damage, not against forgery: anyone can compute a new checksum for a
changed file.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import mmap
from pathlib import Path
from typing import Any, BinaryIO

from ganlane.errors import UserError

PACKAGE = Path(__file__).resolve().parent
#: Weights that ship: ``agent_*.safetensors`` and ``generator_*.safetensors``.
CHECKPOINTS = PACKAGE / "checkpoints"
#: Environment variable with the cache folder; empty switches the cache off.
CACHE_VARIABLE = "GANLANE_CACHE"
#: Bytes that are written to test whether the disk is full; libraries fail with less than this left.
_PROBE_BYTES = 2**20
#: Weights that ship have up to 4.3 MB; a network of 100 M weights has 400 MB.
LARGEST_BYTES = 2**30
#: Ending of the temporary files, whose names begin with a dot.
_PART = ".part"
_BEGIN, _END = b"ganlane sha256 ", b" of this file"
_ZEROS = b"0" * 64
#: Placeholder in the content until :func:`sealed` puts the checksum in.
PLACE = (_BEGIN + _ZEROS + _END).decode()
#: The end of a zip archive: its comment's length, its comment.
_COMMENT = len(PLACE).to_bytes(2, "little") + PLACE.encode()


def cache_folder() -> Path | None:
    """Folder of the cache: ``GANLANE_CACHE``, else ``ganlane`` in the user's cache folder.

    None if switched off, or for a user without a home.
    """
    named = os.environ.get(CACHE_VARIABLE)
    if named is not None:
        return Path(named) if named else None
    try:
        parent = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # no home, as in a container that runs under any number
        return None
    return Path(parent) / "ganlane"


def conf_folder() -> Path:
    """Folder of the YAML files: next to the package in a checkout, inside it in a wheel.

    The one next to it comes first, since an editable install can leave a stale copy behind.

    Raises:
        UserError: neither is there.
    """
    for folder in (PACKAGE.parent / "conf", PACKAGE / "conf"):
        # A folder 'conf' of another project may be next to an installed package.
        if (folder / "train.yaml").is_file() and (folder / "traffic" / "gan.yaml").is_file():
            return folder
    raise UserError(
        f"{PACKAGE}: the folder conf/ is missing next to and inside it; install ganlane again."
    )


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path`` (made if need be); on success sync and
    rename it into place.

    A process killed at any instant leaves either the old file or the new one, never a part of one.

    Raises:
        OSError: the file system refuses. It names ``path`` and has an ``errno``, whatever the
            library that wrote made of it.
        UserError: the path is a folder or a device.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # renaming onto /dev/null would replace it
        kind = "a folder" if path.is_dir() else "a device or a pipe"
        raise UserError(f"{path}: {kind}, where a file was to be written; give the name of a file.")
    path.parent.mkdir(parents=True, exist_ok=True)

    # In the same folder, since a file can be renamed atomically only within one file system.
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{_PART}")
    try:
        # With the permissions that the user's umask leaves; mkstemp() lets only the owner read.
        part.touch(exist_ok=False)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error

    try:
        yield part
        with part.open("rb+") as written:
            # On the disk before the new name is: else a power cut could leave an empty file.
            os.fsync(written.fileno())
        part.replace(path)
    except Exception as error:
        cause = _file_system_error(error, part)
        if cause is None:
            raise
        raise OSError(cause.errno, cause.strerror, str(path)) from error
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def opened(path: str | Path) -> Iterator[BinaryIO]:
    """An open file that takes the place of ``path`` as :func:`atomic_path` says.

    For polars, which cannot write to a path that has bytes beyond the locale's characters.
    """
    with atomic_path(path) as part, part.open("wb") as file:
        yield file


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder next to ``path`` to write into; on success it is renamed to
    ``path``, else removed.

    Raises:
        UserError: there is something at ``path`` already.
        OSError: it names ``path``, or the file in it that was to be written.
    """
    path = Path(path)
    # Never into a folder that holds something: it may be another recording.
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise UserError(
            f"{path}: there already; choose another folder with out=FOLDER, or remove it."
        )
    path.parent.mkdir(parents=True, exist_ok=True)

    # Beside the folder, so that the last step is a rename.
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)  # of a killed process that had the same number
        part.mkdir()
        # Whatever goes wrong in between, the folder of the user stays as it was.
        yield part
        # An empty folder may be there; it gives way.
        if path.is_dir():
            path.rmdir()
        part.replace(path)
    except OSError as error:
        # The hidden folder means nothing to the user.
        name = str(error.filename)
        if not name.startswith(str(part)):
            raise
        whole_name = str(path) + name.removeprefix(str(part))
        raise OSError(error.errno, error.strerror, whole_name) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of killed writes from a folder to which nothing writes now."""
    # The eight characters are random.
    for part in folder.glob(f".*.????????{_PART}"):
        part.unlink(missing_ok=True)


def _file_system_error(error: Exception, part: Path) -> OSError | None:
    """The file system's error when ``part`` was written; None where ``error`` has another cause.

    Libraries report a full disk in messages of their own (torch: "unexpected pos 576 vs 534"), so a
    write is tried.
    """
    if isinstance(error, OSError) and error.errno is not None:
        return error if error.filename in (None, str(part)) else None
    # Libraries written in C report a full disk without an error number; a write tells.
    try:
        with part.open("ab") as file:
            file.write(bytes(_PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as cause:
        return cause
    return None


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write ``content`` to ``path`` atomically."""
    with atomic_path(path) as part:
        part.write_bytes(content)


def write_json(path: str | Path, content: Any) -> None:
    """Write ``content`` to ``path`` as indented JSON, atomically.

    With a checksum if an entry is :data:`PLACE`.
    """
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    encoded = text.encode()
    if PLACE.encode() in encoded:
        encoded = sealed(encoded)
    write_bytes(path, encoded)


def read_whole(path: Path) -> bytes:
    """Content of a file that is judged as a whole: weights, histograms, the state of a fit.

    Raises:
        UserError: it is larger than any of these, so it is not read into memory.
    """
    if path.stat().st_size > LARGEST_BYTES:
        raise UserError(
            f"{path}: more than {LARGEST_BYTES} bytes, which no file of this kind has; give "
            "another file."
        )
    return path.read_bytes()


def sealed(content: bytes) -> bytes:
    """``content``, which holds :data:`PLACE`, with its checksum."""
    # The digits are of the content with zeros in their place, so a reader can compute them too.
    begin = content.index(PLACE.encode()) + len(_BEGIN)
    return content[:begin] + _digits(content, begin) + content[begin + len(_ZEROS) :]


def seal_archive(path: Path) -> None:
    """Give a zip archive without a comment (.pt) its checksum as comment.

    In place, for files too large to be held in memory.
    """
    with path.open("rb+") as file:
        # The last two bytes of a zip archive without a comment are the comment's length, 0.
        file.seek(-2, 2)
        file.write(_COMMENT)
        file.flush()
        with mmap(file.fileno(), 0) as content:
            begin = len(content) - len(PLACE) + len(_BEGIN)
            content[begin : begin + len(_ZEROS)] = _digits(content, begin)


def has_checksum(content: bytes | mmap, path: str | Path) -> bool:
    """Whether ``content`` has a checksum.

    Raises:
        UserError: it has one that does not match; ``path`` is named as the damaged file.
    """
    begin = content.find(_BEGIN)
    end = content.find(_END)
    if begin < 0 and end < 0:
        return False

    # One mark without the other is damage, not a file without a checksum.
    begin += len(_BEGIN)
    if end != begin + len(_ZEROS) or content[begin:end] != _digits(content, begin):
        raise UserError(
            f"{path}: damaged, its content does not have the checksum that was written with it; "
            "take a copy that is whole, or make it again."
        )
    return True


def _digits(content: bytes | mmap, begin: int) -> bytes:
    """Checksum of ``content`` with zeros in the place of the digits at ``begin``."""
    # Views, which copy nothing: a file may be larger than the memory.
    view = memoryview(content)
    digest = hashlib.sha256()
    for part in (view[:begin], _ZEROS, view[begin + len(_ZEROS) :]):
        digest.update(part)
    return digest.hexdigest().encode()


def refuse_without_checksum(path: str | Path) -> None:
    """Raise :class:`UserError`: a file that ganlane writes with a checksum has lost it."""
    raise UserError(
        f"{path}: damaged, the checksum that was written with it is missing; take a copy that is "
        "whole, or make it again."
    )
