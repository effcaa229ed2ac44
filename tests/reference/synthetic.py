"""Synthetic recordings, deterministic and free to share: for tests, and machines without data.

They are not a driver model: vehicles start in slots of their own along the road, keep about one
speed, and some change lanes along half a cosine. No two vehicles overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import polars as pl

from ganlane.data.dense import track_table
from ganlane.data.schema import FRAME_S, sort

LANE_M = 3.5
#: What every vehicle has of the road at the start, m.
SLOT_M = 18.0
SPEED_MPS = 14.0


@dataclass(frozen=True)
class SyntheticTraffic:
    """Size and motion of the scenes.

    Speeds follow :data:`SPEED_MPS` plus a sine of up to ``speed_swing_mps`` and a period of 6 to
    10 s: no two vehicles can collide. A lane change takes 3 to 5 s and ends within the recording.
    """

    scenes: int = 2
    vehicles: int = 12
    lanes: int = 3
    seconds: float = 10.0
    speed_swing_mps: float = 1.5
    changing_share: float = 0.3


def synthetic_scenes(seed: int = 0, **size: float) -> pl.DataFrame:
    """A frame in the schema with the scenes ``synthetic-0``, ``synthetic-1`` and so on.

    ``size`` is :class:`SyntheticTraffic`'s.
    """
    traffic = SyntheticTraffic(**size)
    return sort(pl.concat(_scene(traffic, number, seed) for number in range(traffic.scenes)))


def varied_scenes(count: int) -> pl.DataFrame:
    """The scenes ``scene-0``, ``scene-1`` and so on, of 2, 3 and 4 lanes in turn, each a second
    shorter than the one before.

    The first lasts 9 s; every third driver leaves at 4.5 s.
    """
    scenes = []
    for k in range(count):
        scene = _scene(SyntheticTraffic(lanes=2 + k % 3, seconds=9.0 - k), number=k, seed=0)
        stays = (pl.col("vehicle") % 3 > 0) | (pl.col("frame") <= 45)
        scenes.append(scene.filter(stays).with_columns(scene=pl.lit(f"scene-{k}")))
    return sort(pl.concat(scenes))


def _scene(traffic: SyntheticTraffic, number: int, seed: int) -> pl.DataFrame:
    """One scene; every vehicle is present in every frame."""
    # Each scene has a seed of its own: their number changes none of them.
    random = np.random.default_rng((seed, number))
    n = traffic.vehicles
    time = np.arange(round(traffic.seconds / FRAME_S)) * FRAME_S
    # All lanes are used equally.
    home = random.permutation(np.arange(n) % traffic.lanes)
    # Along the road: a slot each, and a sine around one speed.
    swing = random.uniform(0.3, 1.0, (n, 1)) * traffic.speed_swing_mps
    omega = 2.0 * math.pi / random.uniform(6.0, 10.0, (n, 1))
    phase = random.uniform(0.0, 2.0 * math.pi, (n, 1))
    speed = SPEED_MPS + swing * np.cos(omega * time + phase)
    slots = (np.arange(n) * SLOT_M)[:, None]
    x = slots + SPEED_MPS * time + swing / omega * np.sin(omega * time + phase)
    y = home[:, None] * LANE_M + _across(traffic, time, home, random)
    # The nearest lane, as recordings have it.
    lane = np.rint(y / LANE_M).clip(0, traffic.lanes - 1)
    return track_table(
        f"synthetic-{number}",
        np.ones((len(time), n), bool),
        vehicle=np.arange(1, n + 1),
        x=x.T,
        y=y.T,
        speed=speed.T,
        lane=lane.T,
        length=random.uniform(4.0, 5.5, n).round(2),
        width=random.uniform(1.7, 2.2, n).round(2),
    )


def _across(
    traffic: SyntheticTraffic, time: np.ndarray, home: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Offsets from the first lane's centre, [vehicles, frames].

    A slow wander, and for some a lane change.
    """
    n = traffic.vehicles
    end = time[-1]
    pace = random.uniform(0.3, 0.8, (n, 1))
    phase = random.uniform(0.0, 6.28, (n, 1))
    wander = 0.15 * np.sin(pace * time + phase)
    # To a random side, away from the edges of the road.
    side = random.choice([-1, 1], n)
    side[home == traffic.lanes - 1] = -1
    side[home == 0] = 1
    # A change takes up to 5 s and must fit into the recording.
    changes = (random.uniform(size=n) < traffic.changing_share) & (traffic.lanes > 1) & (end > 6.0)
    lasts = random.uniform(3.0, 5.0, n)
    begins = random.uniform(0.5, np.maximum(end - lasts - 0.5, 0.6))
    # Share of the change that is done, eased by half a cosine.
    done = np.clip((time - begins[:, None]) / lasts[:, None], 0.0, 1.0)
    moved = (changes * side * LANE_M)[:, None]
    return wander + moved * 0.5 * (1.0 - np.cos(math.pi * done))
