"""Recordings in the schema as Parquet: what ``ganlane prepare`` writes and every command reads."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import polars as pl

from ganlane.data.part_files import named
from ganlane.data.schema import FRAME_S, sort, validate
from ganlane.errors import UserError
from ganlane.files import atomic_path

ENDING: Final = ".parquet"


def write_prepared(frame: pl.DataFrame, path: str | Path) -> None:
    """Write a frame in the schema as Parquet, atomically."""
    with atomic_path(path) as part:
        frame.write_parquet(part, compression="zstd")


def is_prepared(path: str | Path) -> bool:
    """Whether ``path`` is meant as Parquet: a file of that ending, or a folder."""
    path = Path(path)
    return path.is_dir() or path.suffix == ENDING


def read_prepared(path: str | Path) -> pl.DataFrame:
    """Read one Parquet file in the schema, or all those of a folder, sorted by scene, vehicle and frame.

    Raises:
        UserError: nothing there, a file that is no Parquet or is damaged, a missing column, or faults in the rows.
    """
    files = prepared_files(path)
    frames = [_read_file(file) for file in files]
    seen: dict[str, Path] = {}
    for file, frame in zip(files, frames):
        for scene in frame["scene"].unique():
            note_scene(scene, file, seen)
    return sort(pl.concat(frames))


def note_scene(scene: str, file: Path, seen: dict[str, Path]) -> None:
    """Note in ``seen`` in which file a scene is.

    Raises:
        UserError: it was in another one too.
    """
    if seen.setdefault(scene, file) != file:
        raise UserError(f"{file}: scene {scene} is in {seen[scene]} too; remove one of them.")


def prepared_files(path: str | Path) -> list[Path]:
    """The Parquet files that ``path`` means: itself, or those of the folder.

    Raises:
        UserError: a folder without any.
    """
    path = Path(path)
    files = sorted(path.glob(f"*{ENDING}")) if path.is_dir() else [path]
    if not files:
        raise UserError(f"{path}: no such file as *{ENDING} in this folder; give what ganlane prepare wrote.")
    return files


def _read_file(path: Path) -> pl.DataFrame:
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a Parquet file that ganlane prepare wrote, or its folder.")
    try:
        frame = pl.read_parquet(path)
    except (pl.exceptions.PolarsError, OSError) as error:
        reason = (str(error).splitlines() or ["damaged"])[0].rstrip(". ")
        raise UserError(f"{path}: not a readable Parquet file ({reason}); prepare it again.") from error
    return validate(frame, str(path), first_line=None)


def cut_into_scenes(frame: pl.DataFrame, seconds: float) -> pl.DataFrame:
    """Cut each recording into scenes of at most ``seconds``, so that some of them can be held out.

    ``us-101-1`` becomes ``us-101-1-000``, ``us-101-1-001`` and so on; frame numbers stay. A track is cut with the
    recording: what was one lane change may be half of one in each of two scenes.
    """
    frames = max(1, round(seconds / FRAME_S))
    first = pl.col("frame").min().over("scene")
    number = ((pl.col("frame") - first) // frames).cast(pl.String).str.zfill(3)
    return sort(frame.with_columns(scene=pl.col("scene") + "-" + number))


def file_name(scene: str) -> str:
    """Name of a scene's file: letters, digits, dots and dashes."""
    return re.sub(r"[^\w.-]+", "_", scene).lstrip(".") + ENDING


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """Yield a folder beside ``path`` to write into; on success it becomes ``path``, else it is removed.

    Raises:
        UserError: there is something at ``path`` already.
        OSError: the file system refuses; it names ``path``, or the file there that was to be.
    """
    path = Path(path)
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise UserError(f"{path}: there already; choose another folder with out=FOLDER, or remove it.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with named(path):
        part = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part"))
        try:
            yield part
            part.chmod(0o755)
            if path.is_dir():
                path.rmdir()
            part.replace(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
