"""How much driving a recording holds: the denominator of every rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from ganlane.data.schema import TRACK, TRACK_STRIDE


@dataclass(frozen=True)
class Exposure:
    """How much driving was seen.

    ``cars`` counts a car once per scene, whatever its tracks; ``road_m`` is the mean length of the road over the
    cars; ``vehicle_km`` is the distance driven.
    """

    scenes: int
    tracks: int
    cars: int
    samples: int
    road_m: float
    vehicle_km: float


def measure_exposure(frame: pl.DataFrame) -> Exposure:
    """Scenes, tracks, cars, length of road and distance driven of a frame in the schema."""
    roads = frame.group_by("scene").agg(
        road=pl.col("x").max() - pl.col("x").min(), cars=(pl.col("vehicle") % TRACK_STRIDE).n_unique()
    )
    driven = (pl.col(name).diff().over(TRACK) ** 2 for name in ("x", "y"))
    return Exposure(
        scenes=roads.height,
        tracks=frame.select(TRACK).n_unique(),
        cars=int(roads["cars"].sum()),
        samples=frame.height,
        road_m=float(np.average(roads["road"].to_numpy(), weights=roads["cars"].to_numpy())),
        vehicle_km=float(frame.select(pl.sum_horizontal(*driven).sqrt().sum()).item()) / 1000.0,
    )
