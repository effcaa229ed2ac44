"""Recordings of any kind, read and written so that every command reads them again.

Scene CSV and Parquet hold recordings that are already straightened and in metres. A scene CSV
counts lanes from the left; Parquet holds the schema itself: ``ganlane prepare`` writes it.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import polars as pl

from ganlane.data.highd import highd_scenes
from ganlane.data.lanes import lane_width, scene_lane_widths
from ganlane.data.ngsim import ngsim_scenes
from ganlane.data.schema import FRAME_S, SCHEMA, RowCount, Scene, sort, validate
from ganlane.data.tables import OnProgress, raise_where, read_table, reason
from ganlane.errors import UserError
from ganlane.files import LARGEST_BYTES, PLACE, has_checksum, sealed, write_bytes
from ganlane.settings.generator import NgsimParameters

#: Columns of a scene CSV: the schema's, but the speed is ``v``; ``y`` is positive to the left and 0
#: at the centre of lane 1, which is the leftmost.
COLUMNS = {"v" if name == "speed" else name: kind for name, kind in SCHEMA.items()}
#: Ending of the files that ``ganlane prepare`` writes.
PARQUET = ".parquet"
#: How a Parquet file begins.
_PARQUET = b"PAR1"


def read_scenes(path: str | Path) -> pl.DataFrame:
    """Read a scene CSV, or what ``ganlane prepare`` wrote, into the schema, sorted.

    Lanes of a CSV are renumbered from the right (a scene's highest number becomes 0), and ``y`` is
    shifted so that it is 0 at the centre of that lane. Positions are not smoothed.

    Args:
        path: CSV with :data:`COLUMNS` (others are ignored), in metres, m/s and 0.1 s a frame; or
            Parquet in the schema, a file ``*.parquet`` or a folder of them.

    Raises:
        UserError: a missing or damaged file, or a scene in two files; the message names file, line
            and column.
    """
    return sort(pl.concat(_read_files(Path(path))))


def write_prepared(frame: pl.DataFrame, path: str | Path) -> None:
    """Write a frame in the schema as Parquet with a checksum, atomically."""
    # In memory first, since the checksum covers the whole content.
    file = io.BytesIO()
    frame.write_parquet(file, compression="zstd", metadata={"checksum": PLACE})
    write_bytes(path, sealed(file.getvalue()))


def cut_into_scenes(frame: pl.DataFrame, seconds: float) -> pl.DataFrame:
    """Cut each recording into scenes of at most ``seconds``, so that some of them can be held out.

    ``us-101-1`` becomes ``us-101-1-000``, ``us-101-1-001`` and so on; frame numbers do not change.
    """
    frames = max(1, round(seconds / FRAME_S))
    # Frames are numbered from any number on.
    first = pl.col("frame").min().over("scene")
    number = ((pl.col("frame") - first) // frames).cast(pl.String).str.zfill(3)
    return sort(frame.with_columns(scene=pl.col("scene") + "-" + number))


def _read_files(path: Path) -> Iterator[pl.DataFrame]:
    """The CSV, or the Parquet files one by one; a scene must not be in two of them."""
    files = sorted(path.glob(f"*{PARQUET}")) if path.is_dir() else [path]
    # An empty folder would otherwise be an empty recording.
    if not files:
        raise UserError(
            f"{path}: no such file as *{PARQUET} in this folder; give what ganlane prepare wrote."
        )
    # Two files that hold one scene would mix its vehicles.
    file_of: dict[str, Path] = {}
    for file in files:
        frame = _read_parquet(file) if file.suffix == PARQUET else _read_csv(file)
        for scene in frame["scene"].unique():
            if file_of.setdefault(scene, file) != file:
                raise UserError(
                    f"{file}: scene {scene} is in {file_of[scene]} too; remove one of them."
                )
        yield frame


def _read_csv(path: Path) -> pl.DataFrame:
    """A scene CSV in the schema: ``y`` and lanes from the right."""
    table = read_table(path, COLUMNS).rename({"v": "speed"})
    raise_where(table["lane"] < 1, table, "lane", path, "is below 1, the leftmost lane")

    scenes = []
    for (name,), scene in validate(table, str(path)).group_by("scene"):
        from_left = scene["lane"].to_numpy() - 1
        # The file does not say how wide its lanes are; the positions do.
        width = lane_width(-scene["y"].to_numpy(), from_left, f"{path}, scene {name}")
        # The rightmost lane in use becomes 0.
        last = int(from_left.max())
        scenes.append(
            scene.with_columns(
                y=pl.col("y") + last * width,
                lane=last + 1 - pl.col("lane"),
            )
        )
    return pl.concat(scenes)


def _read_parquet(path: Path) -> pl.DataFrame:
    """A Parquet file in the schema, with or without a checksum."""
    if not path.is_file():
        raise UserError(
            f"{path}: no such file; give a Parquet file that ganlane prepare wrote, or its folder."
        )
    # A recording may be large; another file so large is not read into memory.
    with path.open("rb") as file:
        begin = file.read(len(_PARQUET))
    if begin != _PARQUET and path.stat().st_size > LARGEST_BYTES:
        raise UserError(
            f"{path}: not a readable Parquet file (it begins otherwise); prepare it again."
        )

    # The checksum is that of the whole file.
    content = path.read_bytes()
    has_checksum(content, path)  # tables of other programs have none
    try:
        frame = pl.read_parquet(content)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise UserError(
            f"{path}: not a readable Parquet file ({reason(error)}); prepare it again."
        ) from error
    # Rows of Parquet are no lines of text.
    return validate(frame, str(path), first_line=None)


def open_scenes(
    kind: str,
    path: str | Path,
    count: RowCount,
    parameters: NgsimParameters | None = None,
    scratch: Path | None = None,
    on_progress: OnProgress | None = None,
) -> Iterator[Scene]:
    """The scenes of recordings of a ``kind``: ``scenes``, ``ngsim`` or ``highd``.

    Args:
        kind: what the files are.
        path: a file, or a folder where the reader takes one.
        count: rows read and dropped are added to it.
        parameters, scratch, on_progress: those of :func:`ngsim_scenes`, and for NGSIM only.

    Raises:
        UserError: a damaged or missing file, or an unknown kind.
    """
    # Each reader yields one scene after the other.
    if kind == "ngsim":
        parameters = parameters or NgsimParameters()
        yield from ngsim_scenes(path, parameters, count, scratch, on_progress)
    elif kind == "highd":
        yield from highd_scenes(path, count)
    elif kind == "scenes":
        for frame in _read_files(Path(path)):
            count.read += frame.height
            widths = scene_lane_widths(frame)
            for (name,), rows in sort(frame).group_by("scene", maintain_order=True):
                yield Scene(str(name), rows, widths[str(name)])
    else:
        raise UserError(f"{kind}: no such kind of recordings; expected scenes, ngsim or highd.")


def read_recordings(
    kind: str,
    path: str | Path,
    parameters: NgsimParameters | None = None,
    on_progress: OnProgress | None = None,
) -> pl.DataFrame:
    """All scenes of recordings in one frame, sorted; for recordings that fit into memory.

    Arguments and errors are those of :func:`open_scenes`; a recording without any usable row is an
    error too.
    """
    # Sorted over all files already.
    if kind == "scenes":
        return read_scenes(path)
    scenes = open_scenes(kind, path, RowCount(), parameters, on_progress=on_progress)
    frames = [scene.frame for scene in scenes]
    if not frames:
        raise UserError(
            f"{path}: no vehicle on any of the lanes kept; give a recording of a road with traffic "
            "on it."
        )
    return sort(pl.concat(frames))
