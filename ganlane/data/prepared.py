"""Recordings measured scene by scene, and written as Parquet."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ganlane.data.lanes import LaneChanges, find_lane_changes, tracks_of_frame
from ganlane.data.recordings import (
    PARQUET,
    cut_into_scenes,
    open_scenes,
    write_prepared,
)
from ganlane.data.schema import FRAME_S, RowCount, Scene
from ganlane.data.statistics import (
    Exposure,
    LaneChangeStatistics,
    describe,
    lane_change_statistics,
    measure_exposure,
    quantities,
)
from ganlane.data.tables import OnProgress
from ganlane.errors import UserError
from ganlane.files import whole_folder
from ganlane.settings.generator import NgsimParameters

#: Accelerations beyond it, which few cars reach, are strong, m/s2.
_STRONG_MPS2 = 3.0
#: Those of the :func:`quantities` that may be strong.
_ACCELERATIONS = ("acceleration_raw", "acceleration_smoothed")


class PooledStatistics:
    """Statistics over scenes: :meth:`add` each one, then read the attributes.

    Attributes:
        scenes: numbers of each scene; rates as in :class:`LaneChangeStatistics`.
            ``nearest_lane_share`` is the share of rows whose recorded lane is the one whose centre
            is nearest: near 1 where the road is straight in the recording's coordinates.
        count: rows read and dropped.
        written: rows written.
        files: names of the files that they were written to.
    """

    def __init__(self) -> None:
        self.count = RowCount()
        self.written = 0
        self.files: list[str] = []
        self.scenes: list[dict[str, Any]] = []
        # Of each scene, in the order in which they were added.
        self._exposures: list[Exposure] = []
        self._changes: list[LaneChanges] = []
        self._samples: list[dict[str, np.ndarray]] = []

    def add(self, scene: Scene) -> dict[str, Any]:
        """Measure one more scene; its numbers, as in ``scenes``."""
        frame = scene.frame
        exposure = measure_exposure(frame)
        tracks = tracks_of_frame(frame, {scene.name: scene.lane_width_m})
        changes = find_lane_changes(tracks)
        # Numbers of their own, which do not hold on to the frame.
        samples = {name: values.copy() for name, values in quantities(frame).items()}
        self._exposures.append(exposure)
        self._changes.append(changes)
        self._samples.append(samples)

        # A scene's own rates, for the table.
        rates = lane_change_statistics(changes, exposure, samples["speed"])
        # From the first frame to the last, both included.
        frames = int(np.ptp(frame["frame"].to_numpy()) + 1)
        is_nearest = tracks.lane == frame["lane"].to_numpy()
        summary = {
            "name": scene.name,
            "rows": frame.height,
            "tracks": exposure.tracks,
            "seconds": round(FRAME_S * frames, 1),
            "lanes": scene.lanes,
            "lane_width_m": scene.lane_width_m,
            "nearest_lane_share": float(np.mean(is_nearest)),
            "vehicle_km": exposure.vehicle_km,
            "mean_speed_mps": float(samples["speed"].mean()),
            "lane_changes": rates.count,
            "srlc": rates.srlc,
            "per_vehicle_km": rates.per_vehicle_km,
            "per_vehicle_km_low": rates.per_vehicle_km_low,
            "per_vehicle_km_high": rates.per_vehicle_km_high,
        }
        self.scenes.append(summary)
        return summary

    @property
    def exposure(self) -> Exposure:
        """Total amount of driving; the road's length is the mean over the cars."""
        parts = _columns(self._exposures)
        # Weighted by cars, as equation 9 counts them; all the others are sums.
        road_m = float(np.average(parts.pop("road_m"), weights=parts["cars"]))
        totals = {name: sum(values) for name, values in parts.items()}
        return Exposure(road_m=road_m, **totals)

    @property
    def changes(self) -> LaneChanges:
        """All lane changes; ``sample`` counts within each scene."""
        parts = _columns(self._changes)
        arrays = {name: np.concatenate(values) for name, values in parts.items()}
        return LaneChanges(**arrays)

    @property
    def lane_changes(self) -> LaneChangeStatistics:
        """Rates, durations and lateral speeds over all scenes."""
        return lane_change_statistics(self.changes, self.exposure, self.sample("speed"))

    def sample(self, quantity: str) -> np.ndarray:
        """All values of one of the :func:`quantities`."""
        return np.concatenate([samples[quantity] for samples in self._samples])

    def strong_share(self, quantity: str) -> float | None:
        """Share of the accelerations beyond 3 m/s2; None without any."""
        strong = np.abs(self.sample(quantity)) > _STRONG_MPS2
        return float(strong.mean()) if len(strong) else None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain numbers and dataclasses, for ``results.json``.

        Returns:
            ``rows`` (read, kept, dropped by reason, written), ``files``, ``exposure``,
            ``lane_changes``, a distribution of each of the :func:`quantities`, shares of strong
            accelerations, and ``scenes``.
        """
        rows = {
            "read": self.count.read,
            "kept": self.count.kept,
            "dropped": dict(self.count.dropped),
            "written": self.written,
        }
        described = {name: describe(self.sample(name)) for name in self._samples[0]}
        shares = {f"{name}_beyond_3_mps2": self.strong_share(name) for name in _ACCELERATIONS}
        return {
            "rows": rows,
            "files": self.files,
            "exposure": self.exposure,
            "lane_changes": self.lane_changes,
            **described,
            **shares,
            "scenes": self.scenes,
        }


def _columns(records: Sequence[Any]) -> dict[str, list[Any]]:
    """The values of each field of equal records."""
    return {name: [getattr(record, name) for record in records] for name in vars(records[0])}


def prepare_recordings(
    kind: str,
    path: str | Path,
    out: str | Path,
    parameters: NgsimParameters | None = None,
    scene_s: float | None = None,
    on_progress: OnProgress | None = None,
    on_scene: Callable[[dict[str, Any]], None] | None = None,
) -> PooledStatistics:
    """Read recordings, write each as a Parquet file into the new folder ``out``, and measure them.

    The folder appears only when everything is written.

    Args:
        kind, path, parameters, on_progress: those of :func:`open_scenes`.
        out: the folder.
        scene_s: recordings are cut into scenes of so many seconds, after they were measured; None:
            they stay whole.
        on_scene: called with the numbers of each recording, when it is written.

    Returns:
        What was measured and written.

    Raises:
        UserError: a damaged or missing file, no moving vehicle in it, or ``out`` exists already.
    """
    # Everything is written into a hidden folder first.
    pooled = PooledStatistics()
    with whole_folder(out) as folder:
        for scene in open_scenes(kind, path, pooled.count, parameters, folder, on_progress):
            # A lot of parked cars has no driving to measure.
            if scene.frame["speed"].max() == 0.0 or scene.frame["frame"].n_unique() < 2:
                pooled.count.drop("scene in which nobody drives", scene.frame.height)
                continue
            summary = pooled.add(scene)

            # Letters, digits, dots and dashes.
            file = re.sub(r"[^\w.-]+", "_", scene.name).lstrip(".") + PARQUET
            if file in pooled.files:
                raise UserError(f"{path}: a second scene that {file} is the file of; rename one.")
            pooled.files.append(file)

            # Measured whole: cutting would censor lane changes.
            frame = cut_into_scenes(scene.frame, scene_s) if scene_s else scene.frame
            write_prepared(frame, folder / file)
            pooled.written += frame.height
            if on_scene is not None:
                on_scene(summary)

        if not pooled.files:
            raise UserError(
                f"{path}: no scene in which anybody drives; give a recording of moving traffic."
            )
    return pooled
