"""Synthetic recordings: small, deterministic, free to share; for tests and for runs on a machine without data.

They are not a driver model: vehicles start in slots of their own along the road, keep about one speed, and some
change lanes along half a cosine. No two vehicles overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import polars as pl

from ganlane.data.schema import FRAME_S, SCHEMA, sort


@dataclass(frozen=True)
class SyntheticTraffic:
    """Speeds follow ``speed_mps`` plus a sine of up to ``speed_swing_mps`` and a period of 6 to 10 s.

    With the default slots no two vehicles can collide. A lane change takes 3 to 5 s and ends within the recording.
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
    """A frame in the schema with ``traffic.scenes`` scenes named ``synthetic-0``, ``synthetic-1`` and so on."""
    traffic = traffic or SyntheticTraffic()
    scenes = [_scene(traffic, number, np.random.default_rng((seed, number))) for number in range(traffic.scenes)]
    return sort(pl.concat(scenes))


def _scene(traffic: SyntheticTraffic, number: int, random: np.random.Generator) -> pl.DataFrame:
    """One scene; every vehicle is present in every frame."""
    n, frames = traffic.vehicles, round(traffic.seconds / FRAME_S)
    time = np.arange(frames) * FRAME_S
    home = random.permutation(np.arange(n) % traffic.lanes)
    x, speed = _along(traffic, time, random)
    y = home[:, None] * traffic.lane_width_m + _across(traffic, time, home, random)
    columns = {
        "scene": np.full(n * frames, f"synthetic-{number}"),
        "vehicle": np.repeat(np.arange(1, n + 1), frames),
        "frame": np.tile(np.arange(frames), n),
        "x": x.ravel(),
        "y": y.ravel(),
        "speed": speed.ravel(),
        "lane": np.rint(y / traffic.lane_width_m).astype(np.int64).clip(0, traffic.lanes - 1).ravel(),
        "length": np.repeat(random.uniform(4.0, 5.5, n).round(2), frames),
        "width": np.repeat(random.uniform(1.7, 2.2, n).round(2), frames),
    }
    return pl.DataFrame(columns, schema=SCHEMA)


def _along(traffic: SyntheticTraffic, time: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds along the road, each [vehicles, frames]: one slot each, and a sine around one speed."""
    n = traffic.vehicles
    swing = random.uniform(0.3, 1.0, (n, 1)) * traffic.speed_swing_mps
    omega = 2.0 * math.pi / random.uniform(6.0, 10.0, (n, 1))
    phase = random.uniform(0.0, 2.0 * math.pi, (n, 1))
    slots = (np.arange(n) * traffic.slot_m)[:, None]
    sway = swing / omega * np.sin(omega * time + phase)
    return slots + traffic.speed_mps * time + sway, traffic.speed_mps + swing * np.cos(omega * time + phase)


def _across(traffic: SyntheticTraffic, time: np.ndarray, home: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Offsets from the first lane's centre, [vehicles, frames]: a slow wander, and for some a lane change."""
    n, end = traffic.vehicles, time[-1]
    wander = traffic.wander_m * np.sin(random.uniform(0.3, 0.8, (n, 1)) * time + random.uniform(0.0, 6.28, (n, 1)))
    side = np.where(home == 0, 1, np.where(home == traffic.lanes - 1, -1, random.choice([-1, 1], n)))
    changes = (random.uniform(size=n) < traffic.changing_share) & (traffic.lanes > 1) & (end > 6.0)
    lasts = random.uniform(3.0, 5.0, n)
    begins = random.uniform(0.5, np.maximum(end - lasts - 0.5, 0.6))
    done = np.clip((time - begins[:, None]) / lasts[:, None], 0.0, 1.0)
    return wander + (changes * side * traffic.lane_width_m)[:, None] * 0.5 * (1.0 - np.cos(math.pi * done))
