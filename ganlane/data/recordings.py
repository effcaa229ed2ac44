"""Recordings of any kind: read, measured scene by scene, and written, so that every command reads
them again.

Scene CSV and Parquet hold recordings that are already straightened and in metres. A scene CSV
counts lanes from the left; Parquet holds the schema itself: ``ganlane prepare`` writes it.
"""

from __future__ import annotations

import io
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from ganlane.data.highd import highd_scenes
from ganlane.data.lanes import (
    LaneChanges,
    find_lane_changes,
    lane_width,
    scene_lane_widths,
    tracks_of_frame,
)
from ganlane.data.ngsim import ngsim_scenes
from ganlane.data.schema import (
    FRAME_S,
    SCHEMA,
    OnProgress,
    RowCount,
    Scene,
    raise_where,
    read_table,
    reason,
    sort,
    validate,
)
from ganlane.data.statistics import (
    Bins,
    Distribution,
    Exposure,
    Histogram,
    LaneChangeStatistics,
    describe,
    lane_change_statistics,
    measure_exposure,
    quantities,
)
from ganlane.errors import UserError
from ganlane.files import PLACE, atomic_path, has_checksum, sealed, write_bytes
from ganlane.settings.generator import NgsimParameters

#: Columns of a scene CSV: the schema's, but the speed is ``v``; ``y`` is positive to the left and 0
#: at the centre of lane 1, which is the leftmost.
COLUMNS: Final = {"v" if name == "speed" else name: kind for name, kind in SCHEMA.items()}
_ENDING: Final = ".parquet"


def read_scenes(path: str | Path) -> pl.DataFrame:
    """Read a scene CSV, or what ``ganlane prepare`` wrote, into the schema, sorted by scene,
    vehicle and frame.

    Lanes of a CSV are renumbered from the right (a scene's highest number becomes 0), and ``y`` is
    shifted so that it is 0 at the centre of that lane. Positions are not smoothed.

    ``path``: CSV with :data:`COLUMNS` (others are ignored), in metres, m/s and 0.1 s a frame; or
    Parquet in the schema, a file ``*.parquet`` or a folder of them.

    Raises:
        UserError: a missing or damaged file, or a scene in two files; the message names file, line
            and column.
    """
    return sort(pl.concat(_read_files(Path(path))))


def write_prepared(frame: pl.DataFrame, path: str | Path) -> None:
    """Write a frame in the schema as Parquet with a checksum, atomically."""
    file = io.BytesIO()
    frame.write_parquet(file, compression="zstd", metadata={"checksum": PLACE})
    write_bytes(path, sealed(file.getvalue()))


def write_scene_csv(frame: pl.DataFrame, path: str | Path) -> None:
    """Write a frame in the schema, with lanes of 3.5 m, as a scene CSV.

    Lane 1 is the leftmost in use in a scene.
    """
    with atomic_path(path) as part:
        scene_csv(frame, pl.col("lane").max().over("scene"), 3.5).write_csv(part)


def scene_csv(frame: pl.DataFrame, leftmost: pl.Expr, lane_width_m: float) -> pl.DataFrame:
    """A frame in the schema as the columns of a scene CSV.

    ``leftmost`` is the number of the leftmost lane.
    """
    y = pl.col("y") - leftmost * lane_width_m
    return frame.with_columns(v=pl.col("speed"), lane=leftmost + 1 - pl.col("lane"), y=y).select(
        COLUMNS.keys()
    )


def cut_into_scenes(frame: pl.DataFrame, seconds: float) -> pl.DataFrame:
    """Cut each recording into scenes of at most ``seconds``, so that some of them can be held out.

    ``us-101-1`` becomes ``us-101-1-000``, ``us-101-1-001`` and so on; frame numbers do not change.
    """
    frames = max(1, round(seconds / FRAME_S))
    first = pl.col("frame").min().over("scene")
    number = ((pl.col("frame") - first) // frames).cast(pl.String).str.zfill(3)
    return sort(frame.with_columns(scene=pl.col("scene") + "-" + number))


def _read_files(path: Path) -> Iterator[pl.DataFrame]:
    """The CSV, or the Parquet files one by one; a scene must not be in two of them."""
    files = sorted(path.glob(f"*{_ENDING}")) if path.is_dir() else [path]
    if not files:
        raise UserError(
            f"{path}: no such file as *{_ENDING} in this folder; give what ganlane prepare wrote."
        )
    file_of: dict[str, Path] = {}
    for file in files:
        frame = _read_parquet(file) if file.suffix == _ENDING else _read_csv(file)
        for scene in frame["scene"].unique():
            if file_of.setdefault(scene, file) != file:
                raise UserError(
                    f"{file}: scene {scene} is in {file_of[scene]} too; remove one of them."
                )
        yield frame


def _read_csv(path: Path) -> pl.DataFrame:
    table = read_table(path, COLUMNS).rename({"v": "speed"})
    raise_where(table["lane"] < 1, table, "lane", path, "is below 1, the leftmost lane")
    scenes = []
    for (name,), scene in validate(table, str(path)).group_by("scene"):
        from_left = scene["lane"].to_numpy() - 1
        width = lane_width(-scene["y"].to_numpy(), from_left, f"{path}, scene {name}")
        last = int(from_left.max())
        scenes.append(
            scene.with_columns(y=pl.col("y") + last * width, lane=last + 1 - pl.col("lane"))
        )
    return pl.concat(scenes)


def _read_parquet(path: Path) -> pl.DataFrame:
    if not path.is_file():
        raise UserError(
            f"{path}: no such file; give a Parquet file that ganlane prepare wrote, or its folder."
        )
    content = path.read_bytes()
    has_checksum(content, path)  # tables of other programs have none
    try:
        frame = pl.read_parquet(content)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise UserError(
            f"{path}: not a readable Parquet file ({reason(error)}); prepare it again."
        ) from error
    return validate(frame, str(path), first_line=None)


#: Bins of each quantity in m/s, m/s2, s or m; quantiles are accurate to a bin's width.
QUANTITIES: Final = {
    "speed": Bins(0.0, 60.0, 6000),
    "acceleration_raw": Bins(-20.0, 20.0, 8000),
    "acceleration_smoothed": Bins(-20.0, 20.0, 8000),
    "headway": Bins(-2.0, 30.0, 6400),
    "time_headway": Bins(0.0, 40.0, 8000),
    "gap": Bins(0.0, 300.0, 6000),
}


@dataclass(frozen=True)
class SceneSummary:
    """One scene in numbers; rates as in :class:`LaneChangeStatistics`.

    ``nearest_lane_share`` is the share of rows whose recorded lane is the one whose centre is
    nearest: near 1 where the road is straight in the recording's coordinates.
    """

    name: str
    rows: int
    tracks: int
    seconds: float
    lanes: int
    lane_width_m: float
    nearest_lane_share: float
    vehicle_km: float
    mean_speed_mps: float
    lane_changes: int
    srlc: float
    per_vehicle_km: float
    per_vehicle_km_low: float
    per_vehicle_km_high: float


class PooledStatistics:
    """Statistics over scenes: :meth:`add` each one, then read the attributes."""

    def __init__(self) -> None:
        self.histograms = {name: Histogram(bins) for name, bins in QUANTITIES.items()}
        self.scenes: list[SceneSummary] = []
        self._exposures: list[Exposure] = []
        self._changes: list[LaneChanges] = []
        #: One number per car: few enough to be stored.
        self._headways: list[np.ndarray] = []
        #: Numbers of accelerations beyond 3 m/s2, which few cars reach.
        self._strong = dict.fromkeys(("acceleration_raw", "acceleration_smoothed"), 0)

    def add(self, scene: Scene) -> SceneSummary:
        """Measure one more scene."""
        frame, exposure = scene.frame, measure_exposure(scene.frame)
        tracks = tracks_of_frame(frame, {scene.name: scene.lane_width_m})
        changes = find_lane_changes(tracks)
        self._exposures.append(exposure)
        self._changes.append(changes)
        for name, values in quantities(frame).items():
            self.histograms[name].add(values)
            if name == "headway":
                self._headways.append(values)
            if name in self._strong:
                self._strong[name] += int(np.count_nonzero(np.abs(values) > 3.0))
        speed = float(frame["speed"].mean())  # type: ignore[arg-type]
        rates = lane_change_statistics(changes, exposure, speed)
        shared = ("srlc", "per_vehicle_km", "per_vehicle_km_low", "per_vehicle_km_high")
        summary = SceneSummary(
            name=scene.name,
            rows=frame.height,
            tracks=exposure.tracks,
            seconds=round(FRAME_S * int(np.ptp(frame["frame"].to_numpy()) + 1), 1),
            lanes=scene.lanes,
            lane_width_m=scene.lane_width_m,
            nearest_lane_share=float(np.mean(tracks.lane == frame["lane"].to_numpy())),
            vehicle_km=exposure.vehicle_km,
            mean_speed_mps=speed,
            lane_changes=rates.count,
            **{name: getattr(rates, name) for name in shared},
        )
        self.scenes.append(summary)
        return summary

    @property
    def exposure(self) -> Exposure:
        """Total amount of driving; the road's length is the mean over the cars."""
        parts = {
            field.name: [getattr(each, field.name) for each in self._exposures]
            for field in fields(Exposure)
        }
        road_m = float(np.average(parts.pop("road_m"), weights=parts["cars"]))
        return Exposure(road_m=road_m, **{name: sum(values) for name, values in parts.items()})

    @property
    def changes(self) -> LaneChanges:
        """All lane changes; ``sample`` counts within each scene."""
        parts = {
            field.name: [getattr(each, field.name) for each in self._changes]
            for field in fields(LaneChanges)
        }
        return LaneChanges(**{name: np.concatenate(values) for name, values in parts.items()})

    @property
    def lane_changes(self) -> LaneChangeStatistics:
        """Rates, durations and lateral speeds over all scenes."""
        return lane_change_statistics(
            self.changes, self.exposure, float(self.describe("speed").mean or 0.0)
        )

    def describe(self, quantity: str) -> Distribution:
        """Summary of a quantity.

        Exact for headways, for others with quantiles accurate to a bin's width.
        """
        if quantity == "headway":
            return describe(np.concatenate([np.empty(0), *self._headways]))
        return self.histograms[quantity].describe()

    def strong_share(self, quantity: str) -> float | None:
        """Share of the accelerations beyond 3 m/s2; None without any."""
        total = self.histograms[quantity].total
        return self._strong[quantity] / total if total else None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain numbers and dataclasses."""
        return {
            "exposure": self.exposure,
            "lane_changes": self.lane_changes,
            **{name: self.describe(name) for name in self.histograms},
            **{f"{name}_beyond_3_mps2": self.strong_share(name) for name in self._strong},
            "scenes": self.scenes,
        }


@dataclass(frozen=True)
class Preparation:
    """Result of :func:`prepare_recordings`.

    Rows read, dropped and written, files, and statistics of all scenes.
    """

    count: RowCount
    written: int
    files: tuple[str, ...]
    statistics: PooledStatistics

    def to_dict(self) -> dict[str, Any]:
        """Numbers for ``results.json``."""
        rows = {
            "read": self.count.read,
            "kept": self.count.kept,
            "dropped": dict(self.count.dropped),
        }
        return {
            "rows": rows | {"written": self.written},
            "files": list(self.files),
            **self.statistics.to_dict(),
        }


def open_scenes(
    kind: str,
    path: str | Path,
    count: RowCount,
    parameters: NgsimParameters | None = None,
    scratch: Path | None = None,
    on_progress: OnProgress | None = None,
) -> Iterator[Scene]:
    """The scenes of recordings of a ``kind``: ``scenes``, ``ngsim`` or ``highd``.

    ``path`` is a file, or a folder where the reader takes one; rows read and dropped are added to
    ``count``. The other arguments are :func:`ngsim_scenes`'s, and for NGSIM only.

    Raises:
        UserError: a damaged or missing file, or an unknown kind.
    """
    if kind == "ngsim":
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
    if kind == "scenes":
        return read_scenes(path)
    frames = [
        scene.frame
        for scene in open_scenes(kind, path, RowCount(), parameters, on_progress=on_progress)
    ]
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
    """Read recordings, write each as a Parquet file into the new folder ``out``, and measure them.

    The folder appears only when everything is written. Recordings are measured first, then cut into
    scenes of ``scene_s`` seconds if it is given. The other arguments are those of
    :func:`open_scenes`.

    Raises:
        UserError: a damaged or missing file, no moving vehicle in it, or ``out`` exists already.
    """
    count, statistics, files, written = RowCount(), PooledStatistics(), [], 0
    with whole_folder(out) as folder:
        for scene in open_scenes(kind, path, count, parameters, folder, on_progress):
            if scene.frame["speed"].max() == 0.0 or scene.frame["frame"].n_unique() < 2:
                count.drop("scene in which nobody drives", scene.frame.height)
                continue
            # Letters, digits, dots and dashes.
            summary, file = (
                statistics.add(scene),
                re.sub(r"[^\w.-]+", "_", scene.name).lstrip(".") + _ENDING,
            )
            if file in files:
                raise UserError(f"{path}: a second scene that {file} is the file of; rename one.")
            files.append(file)
            write_prepared(
                cut_into_scenes(scene.frame, scene_s) if scene_s else scene.frame, folder / file
            )
            written += scene.frame.height
            if on_scene is not None:
                on_scene(summary)
        if not files:
            raise UserError(
                f"{path}: no scene in which anybody drives; give a recording of moving traffic."
            )
    return Preparation(count, written, tuple(files), statistics)


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder next to ``path`` to write into; on success it is renamed to
    ``path``, else removed.

    Raises:
        UserError: there is something at ``path`` already.
        OSError: it names ``path``, or the file in it that was to be written.
    """
    path = Path(path)
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise UserError(
            f"{path}: there already; choose another folder with out=FOLDER, or remove it."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)  # of a killed process that had the same number
        part.mkdir()
        yield part
        if path.is_dir():
            path.rmdir()
        part.replace(path)
    except OSError as error:
        name = str(error.filename)
        if not name.startswith(str(part)):
            raise
        raise OSError(
            error.errno, error.strerror, str(path) + name.removeprefix(str(part))
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
