"""Fetching a large file over HTTP: it goes on where it broke off, and stands in place only when it is whole.

Bytes go to ``.NAME.part`` beside the file, and what the server said of its version to ``.NAME.part.json``. A broken
connection is taken up again with HTTP's Range, guarded by If-Range, so that two versions of a file are never joined;
so is a part that an earlier run left. A server that ignores Range sends everything, and the part begins anew. What
the disk refuses is no fault of the network: it is told at once.
"""

from __future__ import annotations

import hashlib
import http.client
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ganlane.data.part_files import forget, named, note_version, size_of, version_of
from ganlane.data.source import OnProgress
from ganlane.errors import UserError

_PIECE: Final = 2**18


@dataclass(frozen=True)
class DownloadParameters:
    """Patience with a server.

    Attributes:
        timeout_s: without a byte for so long, the connection counts as broken.
        attempts: connections without any progress before giving up.
        wait_s: before the second attempt; doubled each time.
    """

    timeout_s: float = 60.0
    attempts: int = 5
    wait_s: float = 1.0


class _Broken(Exception):
    """The connection ended before the file did."""


@contextmanager
def _connection() -> Iterator[None]:
    """What fails in here is the network; an OSError from elsewhere is the disk's."""
    try:
        yield
    except urllib.error.HTTPError:
        raise
    except (OSError, http.client.HTTPException) as error:
        raise _Broken(str(getattr(error, "reason", None) or error) or type(error).__name__) from error


def download(
    url: str,
    path: str | Path,
    sha256: str | None = None,
    on_progress: OnProgress | None = None,
    parameters: DownloadParameters | None = None,
) -> Path:
    """Fetch ``url`` to ``path``; a file that is there already is kept.

    Args:
        url: http or https.
        path: where to put it.
        sha256: checksum in hexadecimal digits; a file that does not have it is not left in place.
        on_progress: called after every piece.
        parameters: patience.

    Raises:
        UserError: no http address, the server refuses or cannot be reached, or the checksum differs.
        OSError: the disk refuses; it names ``path``. What came is kept for the next time.
    """
    path, parameters = Path(path), parameters or DownloadParameters()
    if urllib.parse.urlsplit(url).scheme not in ("http", "https"):
        raise UserError(f"{url}: not an address of a file; expected http:// or https://.")
    if path.is_file():
        _refuse_other(path, sha256, "remove it, or correct data.sha256")
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with named(path, nameless=True):
        _fetch(url, part, on_progress, parameters)
    try:
        _refuse_other(part, sha256, "it was removed; download again, or correct data.sha256")
    except UserError:
        forget(part)
        raise
    part.replace(path)
    forget(part)
    return path


def _fetch(url: str, part: Path, on_progress: OnProgress | None, parameters: DownloadParameters) -> None:
    """Connect until the file is whole; give up after so many connections that bring nothing."""
    failures, wait = 0, parameters.wait_s
    while True:
        before = size_of(part)
        try:
            _connect(url, part, on_progress, parameters.timeout_s)
            return
        except urllib.error.HTTPError as error:
            if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and before:
                forget(part)  # The part is longer than the file: from another version.
            elif error.code < 500:
                raise UserError(f"{url}: the server says {error.code} {error.reason}; check data.url.") from error
            reason = f"{error.code} {error.reason}"
        except _Broken as error:
            reason = str(error)
        failures = 0 if size_of(part) > before else failures + 1
        if failures >= parameters.attempts:
            raise UserError(
                f"{url}: cannot be fetched, {size_of(part)} bytes came ({reason}); check the network and run the "
                "command again, it goes on from there."
            )
        if failures:
            time.sleep(wait)
            wait *= 2.0


def _connect(url: str, part: Path, on_progress: OnProgress | None, timeout_s: float) -> None:
    """One connection: the rest of the file, or all of it."""
    have, version = size_of(part), version_of(part)
    request = urllib.request.Request(url, headers={"User-Agent": "ganlane", "Accept-Encoding": "identity"})
    if have and version:
        request.add_header("Range", f"bytes={have}-")
        request.add_header("If-Range", version)
    with _connection():
        answer = urllib.request.urlopen(request, timeout=timeout_s)
    with answer:
        goes_on = answer.status == http.HTTPStatus.PARTIAL_CONTENT
        if goes_on and _range_start(answer) != have:
            forget(part)
            raise _Broken("the server sent another part than the one asked for")
        have = have if goes_on else 0
        length = answer.headers.get("Content-Length")
        total = None if length is None else have + int(length)
        if not goes_on:
            note_version(part, answer.headers.get("ETag") or answer.headers.get("Last-Modified"))
        _receive(answer, part, have, total, on_progress)


def _receive(
    answer: http.client.HTTPResponse, part: Path, have: int, total: int | None, on_progress: OnProgress | None
) -> None:
    """Add what comes to the part."""
    with part.open("ab" if have else "wb") as file:
        for piece in _pieces(answer):
            file.write(piece)
            have += len(piece)
            if on_progress is not None:
                on_progress(have, total)
    if total is not None and have < total:
        raise _Broken(f"{have} of {total} bytes came")


def _pieces(answer: http.client.HTTPResponse) -> Iterator[bytes]:
    """What comes, as it comes."""
    while True:
        with _connection():
            piece = answer.read1(_PIECE)
        if not piece:
            return
        yield piece


def _range_start(answer: http.client.HTTPResponse) -> int | None:
    """Where the answer begins, by its Content-Range: ``bytes 100-199/200``."""
    _, _, place = (answer.headers.get("Content-Range") or "").partition("bytes ")
    start = place.partition("-")[0]
    return int(start) if start.isdigit() else None


def _refuse_other(path: Path, sha256: str | None, advice: str) -> None:
    """Compare with the checksum, where one is given."""
    if sha256 is None:
        return
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while piece := file.read(2**20):
            digest.update(piece)
    if digest.hexdigest() != sha256.lower():
        raise UserError(f"{path}: its SHA-256 is {digest.hexdigest()}, expected {sha256.lower()}; {advice}.")
