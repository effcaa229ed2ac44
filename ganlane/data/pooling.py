"""What several scenes say together, scene by scene, so that no two need to be in memory at once."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Final

import numpy as np
import polars as pl

from ganlane.data.distributions import Distribution, describe
from ganlane.data.exposure import Exposure, measure_exposure
from ganlane.data.following import followers, leader_gaps, median_headways
from ganlane.data.histograms import Bins, Histogram
from ganlane.data.lane_change_statistics import LaneChangeStatistics, lane_change_statistics
from ganlane.data.lane_changes import LaneChanges, find_lane_changes
from ganlane.data.scene_summary import SceneSummary, summarise_scene
from ganlane.data.schema import TRACK
from ganlane.data.smoothing import raw_accelerations, smoothed_accelerations
from ganlane.data.source import Scene
from ganlane.data.tracks import tracks_of_frame

#: Quantity to its bins; quantiles are good to a bin's width. m/s, m/s2, s, m.
QUANTITIES: Final = {
    "speed": Bins(0.0, 60.0, 6000),
    "acceleration_raw": Bins(-20.0, 20.0, 8000),
    "acceleration_smoothed": Bins(-20.0, 20.0, 8000),
    "headway": Bins(-2.0, 30.0, 6400),
    "time_headway": Bins(0.0, 40.0, 8000),
    "gap": Bins(0.0, 300.0, 6000),
}
#: Accelerations beyond this are counted apart, m/s2: few cars can.
STRONG_MPS2: Final = 3.0


class PooledStatistics:
    """Statistics over scenes: :meth:`add` each one, then read the attributes."""

    def __init__(self) -> None:
        self.histograms = {name: Histogram(bins) for name, bins in QUANTITIES.items()}
        self.scenes: list[SceneSummary] = []
        self._exposures: list[Exposure] = []
        self._changes: list[LaneChanges] = []
        #: One per car: few enough to be kept as they are.
        self._headways: list[np.ndarray] = []
        self._strong = dict.fromkeys(("acceleration_raw", "acceleration_smoothed"), 0)

    def add(self, scene: Scene) -> SceneSummary:
        """Measure one more scene."""
        exposure = measure_exposure(scene.frame)
        tracks = tracks_of_frame(scene.frame, {scene.name: scene.lane_width_m})
        changes = find_lane_changes(tracks)
        quantities = _quantities(scene.frame)
        self._headways.append(quantities["headway"])
        for name, values in quantities.items():
            self.histograms[name].add(values)
            if name in self._strong:
                self._strong[name] += int(np.count_nonzero(np.abs(values) > STRONG_MPS2))
        self._exposures.append(exposure)
        self._changes.append(changes)
        agreeing = float(np.mean(tracks.lane == scene.frame["lane"].to_numpy()))
        self.scenes.append(summarise_scene(scene, exposure, changes, agreeing))
        return self.scenes[-1]

    @property
    def exposure(self) -> Exposure:
        """All driving seen; the road's length is the mean over the cars."""
        cars = [each.cars for each in self._exposures]
        total = {
            name: sum(getattr(each, name) for each in self._exposures)
            for name in ("scenes", "tracks", "cars", "samples", "vehicle_km")
        }
        return Exposure(road_m=float(np.average([each.road_m for each in self._exposures], weights=cars)), **total)

    @property
    def changes(self) -> LaneChanges:
        """All lane changes; ``sample`` counts within each scene."""
        parts = {field.name: [getattr(each, field.name) for each in self._changes] for field in fields(LaneChanges)}
        return LaneChanges(**{name: np.concatenate(values) for name, values in parts.items()})

    @property
    def lane_changes(self) -> LaneChangeStatistics:
        """Rates, durations and lateral speeds over all scenes."""
        return lane_change_statistics(self.changes, self.exposure, float(self.describe("speed").mean or 0.0))

    def describe(self, quantity: str) -> Distribution:
        """Summary of a quantity: headways exactly, others with quantiles good to a bin's width."""
        if quantity == "headway":
            return describe(np.concatenate([np.empty(0), *self._headways]))
        return self.histograms[quantity].describe()

    def strong_share(self, quantity: str) -> float | None:
        """Share of the accelerations beyond 3 m/s2; None without any."""
        total = self.histograms[quantity].total
        return self._strong[quantity] / total if total else None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain numbers and dataclasses."""
        described = {name: self.describe(name) for name in self.histograms}
        strong = {f"{name}_beyond_3_mps2": self.strong_share(name) for name in self._strong}
        return {
            "exposure": self.exposure,
            "lane_changes": self.lane_changes,
            **described,
            **strong,
            "scenes": self.scenes,
        }


def _quantities(frame: pl.DataFrame) -> dict[str, np.ndarray]:
    """Samples of every quantity in one scene; gaps and time headways of those who follow somebody."""
    # Sorting is what takes memory: once, and no more columns than needed.
    behind = leader_gaps(frame.select("scene", "vehicle", "frame", "x", "speed", "lane", "length")).select(
        *TRACK, "speed", "gap"
    )
    following = followers(behind)
    return {
        "speed": frame["speed"].to_numpy(),
        "acceleration_raw": raw_accelerations(frame).to_numpy(),
        "acceleration_smoothed": smoothed_accelerations(frame).to_numpy(),
        "headway": median_headways(following).to_numpy(),
        "time_headway": (following["gap"] / following["speed"]).to_numpy(),
        "gap": behind["gap"].to_numpy(),
    }
