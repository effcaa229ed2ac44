"""A download that resumes.

Bytes are written to ``.NAME.part`` next to the file, and the server's version of it to
``.NAME.part.version``. After a broken connection, or an earlier run that was interrupted, the
download resumes with HTTP's Range, guarded by If-Range, so that two versions of a file are never
joined. If the server ignores Range, the download starts again. Errors of the disk are not retried.
The file gets its name only when it is complete.
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
from typing import Any, Final

from ganlane.data.tables import OnProgress
from ganlane.errors import UserError

_SCHEMES: Final = ("http", "https")
#: Larger files are refused, bytes: NGSIM's largest has 2 GB.
MOST_BYTES: Final = 64 * 2**30


class _BrokenConnection(Exception):
    """The connection ended before the file did."""


def download(
    url: str,
    path: str | Path,
    sha256: str | None = None,
    on_progress: OnProgress | None = None,
    timeout_s: float = 60.0,
    attempts: int = 5,
    wait_s: float = 1.0,
    most_bytes: int = MOST_BYTES,
) -> Path:
    """Download ``url`` (http or https) to ``path``; a file that exists already is kept.

    Args:
        sha256: checksum in hexadecimal digits; a downloaded file with another checksum is removed.
        timeout_s: without a byte for this long, the connection counts as broken.
        attempts: connections without any progress before giving up.
        wait_s: before the second attempt; doubled each time.
        most_bytes: a larger file is refused, as soon as the server tells its size or that many
            bytes have come.

    Raises:
        UserError: not an http address, the server sends to one, refuses or cannot be reached, the
            file is too large, or the checksum differs.
        OSError: the disk's error; it names ``path``. Received bytes are kept for the next run.
    """
    path = Path(path)
    if url.partition("://")[0].lower() not in _SCHEMES:
        raise UserError(f"{url}: not an address of a file; expected http:// or https://.")
    # A file that is there is never replaced: it may be the user's own.
    if path.is_file():
        _check_sha256(path, sha256, "remove it, or correct data.sha256")
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    # The path appears only when everything has come and the checksum is right.
    part = _Part(url, path, most_bytes, timeout_s, on_progress)
    try:
        part.fetch(attempts, wait_s)
    except OSError as error:  # The disk's, for the network's are caught below.
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        _check_sha256(part.file, sha256, "it was removed; download again, or correct data.sha256")
    except UserError:
        part.remove()
        raise
    # Atomic, on one file system.
    part.file.replace(path)
    part.remove()
    return path


@dataclass(frozen=True)
class _Part:
    """The incomplete file ``.NAME.part`` of ``url`` next to ``path``, and a note of its version.

    The other attributes are arguments of :func:`download`.
    """

    url: str
    path: Path
    most_bytes: int
    timeout_s: float
    on_progress: OnProgress | None

    @property
    def file(self) -> Path:
        """Hidden, beside the file, so that the last step is a rename."""
        return self.path.with_name(f".{self.path.name}.part")

    @property
    def note(self) -> Path:
        """Holds the server's identifier of the version; empty if it tells none."""
        return self.path.with_name(f".{self.path.name}.part.version")

    @property
    def size(self) -> int:
        """Bytes received so far."""
        return self.file.stat().st_size if self.file.is_file() else 0

    def check_size(self, size: int) -> None:
        """Refuse more bytes than wanted; what came of them is removed."""
        if size > self.most_bytes:
            self.remove()
            raise UserError(
                f"{self.url}: the file has {size / 1e9:.3g} GB or more, more than "
                f"{self.most_bytes / 1e9:.3g}; check data.url, or fetch it yourself and give "
                "data.path."
            )

    def remove(self) -> None:
        """Remove the incomplete file and its note."""
        self.file.unlink(missing_ok=True)
        self.note.unlink(missing_ok=True)

    def fetch(self, attempts: int, wait_s: float) -> None:
        """Connect until the file is complete.

        Give up after ``attempts`` connections in a row that bring nothing.
        """
        # Only connections in a row without any progress count.
        failures = 0
        while True:
            before = self.size
            try:
                self.connect()
                return
            except urllib.error.HTTPError as error:
                if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and before:
                    self.remove()  # It is longer than the file, so it is of another version.
                # Client errors stay; server errors may pass.
                elif error.code < 500:
                    what = f"{error.code} {' '.join(str(error.reason).split())}"
                    raise UserError(
                        f"{self.url}: the server says {what}; check data.url."
                    ) from error
                reason = f"{error.code} {error.reason}"
            except _BrokenConnection as error:
                reason = str(error)
            failures = 0 if self.size > before else failures + 1
            if failures >= attempts:
                raise UserError(
                    f"{self.url}: cannot be fetched, {self.size} bytes came ({reason}); check the "
                    "network and run the command again, it continues from there."
                )
            # Longer each time, to spare a server in trouble.
            if failures:
                time.sleep(wait_s)
                wait_s *= 2.0

    def connect(self) -> None:
        """One connection: the rest of the file, or all of it."""
        received = self.size
        headers = {"User-Agent": "ganlane", "Accept-Encoding": "identity"}
        version = self.note.read_text("latin-1") if self.note.is_file() else ""
        # Without a version the server may send the rest of another file. A weak ETag does not
        # promise equal bytes.
        if received and version and not version.startswith("W/"):
            headers |= {"Range": f"bytes={received}-", "If-Range": version}
        with _network_errors():
            request = urllib.request.Request(self.url, headers=headers)
            opener = urllib.request.build_opener(_HttpOnly)
            answer = opener.open(request, timeout=self.timeout_s)
        with answer:
            resumes = answer.status == http.HTTPStatus.PARTIAL_CONTENT
            # Content-Range is ``bytes 100-199/200``.
            place = answer.headers.get("Content-Range") or ""
            if resumes and not place.startswith(f"bytes {received}-"):
                self.remove()
                raise _BrokenConnection("the server sent another part than the one asked for")
            received = received if resumes else 0
            length = (answer.headers.get("Content-Length") or "").strip()
            # A length that is no number tells nothing; 19 digits are more bytes than there are.
            total = received + int(length[:19]) if length.isdecimal() else None
            # Refused before anything is written, if the server tells the size.
            self.check_size(max(received, total or 0))
            if not resumes:
                version = answer.headers.get("ETag") or answer.headers.get("Last-Modified") or ""
                self.note.write_text(version, "latin-1")
            # An answer to the whole request begins the file anew.
            with self.file.open("ab" if received else "wb") as file:
                while True:
                    with _network_errors():
                        piece = answer.read1(2**18)
                    if not piece:
                        break
                    received += len(piece)
                    self.check_size(received)
                    file.write(piece)
                    if self.on_progress is not None:
                        self.on_progress(received, total)
        # An early end looks like a complete answer otherwise.
        if total is not None and received < total:
            raise _BrokenConnection(f"{received} of {total} bytes came")


class _HttpOnly(urllib.request.HTTPRedirectHandler):
    """Follows no redirection to another protocol."""

    def redirect_request(
        self,
        req: Any,
        fp: Any,
        code: Any,
        msg: Any,
        headers: Any,
        newurl: str,
    ) -> Any:
        if urllib.parse.urlsplit(newurl).scheme not in _SCHEMES:
            raise UserError(
                f"{req.full_url}: the server sends to {newurl[:200]}; expected http:// or "
                "https://, check data.url."
            )
        return super().redirect_request(req, fp, code, msg, headers, newurl)


@contextmanager
def _network_errors() -> Iterator[None]:
    """Errors in this context are the network's; an OSError elsewhere is the disk's."""
    try:
        yield
    except urllib.error.HTTPError:
        raise
    # A ValueError comes from an address that is none.
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise _BrokenConnection(
            str(getattr(error, "reason", None) or error) or type(error).__name__
        ) from error


def _check_sha256(
    path: Path,
    sha256: str | None,
    advice: str,
) -> None:
    """Compare with the checksum, if one is given."""
    if sha256 is None:
        return
    # In pieces: the file may be larger than the memory.
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(2**20):
            digest.update(piece)
    if digest.hexdigest() != sha256.lower():
        raise UserError(
            f"{path}: its SHA-256 is {digest.hexdigest()}, expected {sha256.lower()}; {advice}."
        )
