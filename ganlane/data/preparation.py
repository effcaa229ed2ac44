"""From any reader to Parquet and figures: one scene at a time, so that memory does not grow with the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from ganlane.data.highd import highd_scenes
from ganlane.data.ngsim import ngsim_scenes
from ganlane.data.ngsim_rows import NgsimParameters
from ganlane.data.pooling import PooledStatistics
from ganlane.data.prepared import cut_into_scenes, file_name, whole_folder, write_prepared
from ganlane.data.scene_summary import SceneSummary
from ganlane.data.scenes import read_scenes, scene_csv_scenes
from ganlane.data.schema import sort
from ganlane.data.source import OnProgress, RowCount, Scene
from ganlane.errors import UserError


@dataclass(frozen=True)
class Preparation:
    """What was prepared: rows read and dropped, rows and files written, and the statistics of all scenes."""

    count: RowCount
    written: int
    files: tuple[str, ...]
    statistics: PooledStatistics

    def to_dict(self) -> dict[str, Any]:
        """Numbers for ``results.json``."""
        count = self.count
        rows = {"read": count.read, "kept": count.kept, "dropped": dict(count.dropped), "written": self.written}
        return {"rows": rows, "files": list(self.files), **self.statistics.to_dict()}


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
        kind: which reader.
        path: file, or folder where the reader takes one.
        count: rows read and dropped are added to it.
        parameters: what to take of an NGSIM file.
        scratch: folder for rows that are put aside (NGSIM).
        on_progress: called with the bytes read (NGSIM).

    Raises:
        UserError: a damaged or missing file, or no such kind.
    """
    if kind == "ngsim":
        return ngsim_scenes(path, parameters, count, scratch, on_progress)
    if kind == "highd":
        return highd_scenes(path, count)
    if kind == "scenes":
        return scene_csv_scenes(path, count)
    raise UserError(f"{kind}: no such kind of recordings; expected scenes, ngsim or highd.")


def read_recordings(
    kind: str, path: str | Path, parameters: NgsimParameters | None = None, on_progress: OnProgress | None = None
) -> pl.DataFrame:
    """All scenes of recordings in one frame, sorted; for what fits into memory.

    Arguments and errors are those of :func:`open_scenes`; a file without any row to use is an error too.
    """
    if kind == "scenes":
        return read_scenes(path)
    scenes = open_scenes(kind, path, RowCount(), parameters, on_progress=on_progress)
    frames = [scene.frame for scene in scenes]
    if not frames:
        raise UserError(
            f"{path}: no vehicle on any of the lanes kept; give a recording of a road with traffic on it."
        )
    return sort(pl.concat(frames))


def prepare_recordings(
    kind: str,
    path: str | Path,
    out: str | Path,
    parameters: NgsimParameters | None = None,
    scene_s: float | None = None,
    on_progress: OnProgress | None = None,
    on_scene: Callable[[SceneSummary], None] | None = None,
) -> Preparation:
    """Read recordings, write each as a Parquet file into the folder ``out``, and measure them.

    Nothing stands at ``out`` until everything is written.

    Args:
        kind, path, parameters: as :func:`open_scenes` has them.
        out: folder to make.
        scene_s: cut recordings into scenes of so many seconds when they are written; they are measured whole.
        on_progress: called with the bytes read (NGSIM).
        on_scene: called after each recording.

    Raises:
        UserError: a damaged or missing file, nothing in it that drives, or something at ``out`` already.
    """
    count, statistics, files, written = RowCount(), PooledStatistics(), [], 0
    with whole_folder(out) as folder:
        for scene in open_scenes(kind, path, count, parameters, folder, on_progress):
            if scene.frame["speed"].max() == 0.0 or scene.frame["frame"].n_unique() < 2:
                count.drop("scene in which nobody drives", scene.frame.height)
                continue
            summary = statistics.add(scene)
            if file_name(scene.name) in files:
                raise UserError(f"{path}: a second scene that {file_name(scene.name)} is the file of; rename one.")
            files.append(file_name(scene.name))
            write_prepared(cut_into_scenes(scene.frame, scene_s) if scene_s else scene.frame, folder / files[-1])
            written += scene.frame.height
            if on_scene is not None:
                on_scene(summary)
        if not files:
            raise UserError(f"{path}: no scene in which anybody drives; give a recording of moving traffic.")
    return Preparation(count, written, tuple(files), statistics)
