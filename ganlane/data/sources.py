"""Where recordings come from: this machine's folder, a download that resumes, or a random
generator.

**Downloads.** Bytes are written to ``.NAME.part`` next to the file, and the server's version of it
to ``.NAME.part.json``. After a broken connection, or an earlier run that was interrupted, the
download resumes with HTTP's Range, guarded by If-Range, so that two versions of a file are never
joined. If the server ignores Range, the download starts again. Errors of the disk are not retried.
The file gets its name only when it is complete.

**Synthetic recordings** are deterministic and free to share: for tests and for machines without
data. They are not a driver model: vehicles start in slots of their own along the road, keep about
one speed, and some change lanes along half a cosine. No two vehicles overlap.
"""

from __future__ import annotations

import hashlib
import http.client
import json
import math
import os
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from tqdm import tqdm

from ganlane.data.schema import FRAME_S, SCHEMA, OnProgress, sort
from ganlane.errors import UserError
from ganlane.files import write_json
from ganlane.settings.generator import DataConfig, NgsimDataConfig

#: Environment variable with the folder of the recordings.
DATA_VARIABLE: Final = "GANLANE_DATA"
SCENES: Final = Path("ngsim") / "us101_scenes.csv"
_FOLDER = Path("shared") / "data"
_SCHEMES: Final = ("http", "https")
#: Larger files are refused, bytes: NGSIM's largest has 2 GB.
MOST_BYTES: Final = 64 * 2**30


def data_folder() -> Path | None:
    """Folder of the recordings: ``GANLANE_DATA``, else ``../shared/data`` next to the checkout or
    the current folder.

    Raises:
        UserError: the folder in ``GANLANE_DATA`` does not exist.
    """
    named = os.environ.get(DATA_VARIABLE)
    if named:
        if not Path(named).is_dir():
            raise UserError(
                f"{DATA_VARIABLE}={named}: no such folder; set it to the folder of the recordings or unset it."
            )
        return Path(named)
    checkout = Path(__file__).resolve().parents[2]
    candidates = (checkout.parent / _FOLDER, Path.cwd().parent / _FOLDER)
    return next((folder for folder in candidates if folder.is_dir()), None)


def default_scenes() -> Path:
    """Path of the US-101 scene CSV: ``ngsim/us101_scenes.csv`` in :func:`data_folder`, or the file
    directly in it.

    Raises:
        UserError: it does not exist.
    """
    folder = data_folder()
    candidates = [] if folder is None else [folder / SCENES, folder / SCENES.name]
    for path in candidates:
        if path.is_file():
            return path
    looked = ", ".join(map(str, candidates)) or f"../{_FOLDER}"
    raise UserError(
        f"no recordings found (looked for {looked}); give data.path=FILE with a scene CSV, "
        f"or set {DATA_VARIABLE} to a folder that holds {SCENES}."
    )


def recordings_path(data: DataConfig) -> Path:
    """Path of the recordings that the group ``data`` names, downloaded first if asked for.

    Raises:
        UserError: there is no path and no default, or an error of :func:`download`.
    """
    if data.format != "scenes" and data.path is None:
        raise UserError(f"data={data.format}: which file is missing; give data.path=FILE.")
    path = Path(data.path) if data.path else default_scenes()
    if isinstance(data, NgsimDataConfig) and data.download:
        with byte_progress("download") as progress:
            download(data.url, path, data.sha256, progress)
    return path


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
    if path.is_file():
        _check_sha256(path, sha256, "remove it, or correct data.sha256")
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    part = _Part(url, path, most_bytes)
    try:
        _fetch(part, on_progress, timeout_s, attempts, wait_s)
    except OSError as error:  # The disk's, for the network's are caught below.
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        _check_sha256(part.file, sha256, "it was removed; download again, or correct data.sha256")
    except UserError:
        part.remove()
        raise
    part.file.replace(path)
    part.remove()
    return path


class _Part:
    """The incomplete file ``.NAME.part`` of ``url`` next to ``path``, and a note of its version."""

    def __init__(self, url: str, path: Path, most_bytes: int) -> None:
        self.url, self.most_bytes = url, most_bytes
        self.file = path.with_name(f".{path.name}.part")
        self._note = path.with_name(f".{path.name}.part.json")

    @property
    def size(self) -> int:
        """Bytes received so far."""
        return self.file.stat().st_size if self.file.is_file() else 0

    @property
    def version(self) -> str | None:
        """The server's identifier of the version; None where the download cannot be resumed."""
        try:
            version = json.loads(self._note.read_text())["version"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return version if isinstance(version, str) and not version.startswith("W/") else None

    @version.setter
    def version(self, version: str | None) -> None:
        write_json(self._note, {"version": version})

    def check_size(self, size: int) -> None:
        """Refuse more bytes than wanted; what came of them is removed."""
        if size > self.most_bytes:
            self.remove()
            raise UserError(
                f"{self.url}: the file has {size / 1e9:.3g} GB or more, more than {self.most_bytes / 1e9:.3g}; check "
                "data.url, or fetch it yourself and give data.path."
            )

    def remove(self) -> None:
        """Remove the incomplete file and its note."""
        self.file.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)


def _fetch(
    part: _Part, on_progress: OnProgress | None, timeout_s: float, attempts: int, wait_s: float
) -> None:
    """Connect until the file is complete.

    Give up after ``attempts`` connections in a row that bring nothing.
    """
    failures = 0
    while True:
        before = part.size
        try:
            _connect(part, on_progress, timeout_s)
            return
        except urllib.error.HTTPError as error:
            if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and before:
                part.remove()  # It is longer than the file, so it is of another version.
            elif error.code < 500:
                what = f"{error.code} {' '.join(str(error.reason).split())}"
                raise UserError(f"{part.url}: the server says {what}; check data.url.") from error
            reason = f"{error.code} {error.reason}"
        except _BrokenConnection as error:
            reason = str(error)
        failures = 0 if part.size > before else failures + 1
        if failures >= attempts:
            raise UserError(
                f"{part.url}: cannot be fetched, {part.size} bytes came ({reason}); check the network and run the "
                "command again, it continues from there."
            )
        if failures:
            time.sleep(wait_s)
            wait_s *= 2.0


class _HttpOnly(urllib.request.HTTPRedirectHandler):
    """Follows no redirection to another protocol."""

    def redirect_request(
        self, req: Any, fp: Any, code: Any, msg: Any, headers: Any, newurl: str
    ) -> Any:
        if urllib.parse.urlsplit(newurl).scheme not in _SCHEMES:
            raise UserError(
                f"{req.full_url}: the server sends to {newurl[:200]}; expected http:// or https://, check data.url."
            )
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _connect(part: _Part, on_progress: OnProgress | None, timeout_s: float) -> None:
    """One connection: the rest of the file, or all of it."""
    received, headers = part.size, {"User-Agent": "ganlane", "Accept-Encoding": "identity"}
    if received and (version := part.version):
        headers |= {"Range": f"bytes={received}-", "If-Range": version}
    with _network_errors():
        request = urllib.request.Request(part.url, headers=headers)
        answer = urllib.request.build_opener(_HttpOnly).open(request, timeout=timeout_s)
    with answer:
        resumes = answer.status == http.HTTPStatus.PARTIAL_CONTENT
        # Content-Range is ``bytes 100-199/200``.
        if resumes and not (answer.headers.get("Content-Range") or "").startswith(
            f"bytes {received}-"
        ):
            part.remove()
            raise _BrokenConnection("the server sent another part than the one asked for")
        received = received if resumes else 0
        length = (answer.headers.get("Content-Length") or "").strip()
        # A length that is no number tells nothing; 19 digits are more bytes than there are.
        total = received + int(length[:19]) if length.isdecimal() else None
        part.check_size(max(received, total or 0))
        if not resumes:
            part.version = answer.headers.get("ETag") or answer.headers.get("Last-Modified")
        with part.file.open("ab" if received else "wb") as file:
            while True:
                with _network_errors():
                    piece = answer.read1(2**18)
                if not piece:
                    break
                received += len(piece)
                part.check_size(received)
                file.write(piece)
                if on_progress is not None:
                    on_progress(received, total)
    if total is not None and received < total:
        raise _BrokenConnection(f"{received} of {total} bytes came")


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


def _check_sha256(path: Path, sha256: str | None, advice: str) -> None:
    """Compare with the checksum, if one is given."""
    if sha256 is None:
        return
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(2**20):
            digest.update(piece)
    if digest.hexdigest() != sha256.lower():
        raise UserError(
            f"{path}: its SHA-256 is {digest.hexdigest()}, expected {sha256.lower()}; {advice}."
        )


@contextmanager
def byte_progress(what: str) -> Iterator[OnProgress]:
    """Shows bytes done, rate and time left on stderr.

    Without a terminal every 10 s, and nothing of shorter work.
    """
    quiet_s = 0.0 if sys.stderr.isatty() else 10.0
    with tqdm(
        desc=what,
        unit="B",
        unit_scale=True,
        file=sys.stderr,
        delay=quiet_s,
        mininterval=max(0.1, quiet_s),
    ) as bar:

        def show(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


@dataclass(frozen=True)
class SyntheticTraffic:
    """Speeds follow ``speed_mps`` plus a sine of up to ``speed_swing_mps`` and a period of 6 to 10
    s.

    With the default slots no two vehicles can collide. A lane change takes 3 to 5 s and ends within
    the recording.
    """

    scenes: int = 2
    vehicles: int = 12
    lanes: int = 3
    seconds: float = 10.0
    lane_width_m: float = 3.5
    slot_m: float = 18.0
    speed_mps: float = 14.0
    speed_swing_mps: float = 1.5
    changing_share: float = 0.3
    wander_m: float = 0.15


def synthetic_scenes(traffic: SyntheticTraffic | None = None, seed: int = 0) -> pl.DataFrame:
    """A frame in the schema with ``traffic.scenes`` scenes named ``synthetic-0``, ``synthetic-1``
    and so on.
    """
    traffic = traffic or SyntheticTraffic()
    return sort(
        pl.concat(_synthetic_scene(traffic, number, seed) for number in range(traffic.scenes))
    )


def _synthetic_scene(traffic: SyntheticTraffic, number: int, seed: int) -> pl.DataFrame:
    """One scene; every vehicle is present in every frame."""
    random = np.random.default_rng((seed, number))
    n, frames = traffic.vehicles, round(traffic.seconds / FRAME_S)
    time = np.arange(frames) * FRAME_S
    home = random.permutation(np.arange(n) % traffic.lanes)
    # Along the road: a slot each, and a sine around one speed.
    swing = random.uniform(0.3, 1.0, (n, 1)) * traffic.speed_swing_mps
    omega = 2.0 * math.pi / random.uniform(6.0, 10.0, (n, 1))
    phase = random.uniform(0.0, 2.0 * math.pi, (n, 1))
    speed = traffic.speed_mps + swing * np.cos(omega * time + phase)
    slots = (np.arange(n) * traffic.slot_m)[:, None]
    x = slots + traffic.speed_mps * time + swing / omega * np.sin(omega * time + phase)
    y = home[:, None] * traffic.lane_width_m + _across(traffic, time, home, random)
    columns = {
        "scene": np.full(n * frames, f"synthetic-{number}"),
        "vehicle": np.repeat(np.arange(1, n + 1), frames),
        "frame": np.tile(np.arange(frames), n),
        "x": x.ravel(),
        "y": y.ravel(),
        "speed": speed.ravel(),
        "lane": np.rint(y / traffic.lane_width_m)
        .astype(np.int64)
        .clip(0, traffic.lanes - 1)
        .ravel(),
        "length": np.repeat(random.uniform(4.0, 5.5, n).round(2), frames),
        "width": np.repeat(random.uniform(1.7, 2.2, n).round(2), frames),
    }
    return pl.DataFrame(columns, schema=SCHEMA)


def _across(
    traffic: SyntheticTraffic, time: np.ndarray, home: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Offsets from the first lane's centre, [vehicles, frames].

    A slow wander, and for some a lane change.
    """
    n, end = traffic.vehicles, time[-1]
    wander = traffic.wander_m * np.sin(
        random.uniform(0.3, 0.8, (n, 1)) * time + random.uniform(0.0, 6.28, (n, 1))
    )
    side = np.where(
        home == 0, 1, np.where(home == traffic.lanes - 1, -1, random.choice([-1, 1], n))
    )
    changes = (random.uniform(size=n) < traffic.changing_share) & (traffic.lanes > 1) & (end > 6.0)
    lasts = random.uniform(3.0, 5.0, n)
    begins = random.uniform(0.5, np.maximum(end - lasts - 0.5, 0.6))
    done = np.clip((time - begins[:, None]) / lasts[:, None], 0.0, 1.0)
    return wander + (changes * side * traffic.lane_width_m)[:, None] * 0.5 * (
        1.0 - np.cos(math.pi * done)
    )
