"""Recorded scenes as tensors that replay gathers from: all samples in one table, and where episodes may start.

A sample is one vehicle in one frame. The samples of a track follow each other, 0.1 s apart, so the vehicle of
sample ``s`` stands ``k`` steps later at sample ``s + k``, as long as its track goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray
from torch import Tensor

from ganlane.data import FRAME_S, Tracks, scene_lane_counts, scene_lane_widths, tracks_of_frame
from ganlane.errors import UserError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: So many vehicles, the ego included, are kept at a start: more than anybody simulates around one ego.
MOST_VEHICLES = 128
#: Heading and acceleration are taken over so many frames before and after (half a second), or what the track has.
_HALF_WINDOW = 5
#: A vehicle that moves less than this in the window keeps its heading along the road, m.
_LEAST_PATH_M = 1.0
#: A recorded driver wants to go at least this fast, m/s (he may be standing in a jam all the time).
LEAST_DESIRED_SPEED_MPS = 10.0


@dataclass(frozen=True)
class Recordings:
    """R samples of S scenes and K places where an episode may start.

    Attributes:
        names: of the S scenes.
        samples: [R, 8] float64, the float fields of ``vehicles`` in the order of ``ganlane.keys.VEHICLE_FLOATS``.
        last: [R] the last sample of each sample's track.
        starts: [K, P] samples at an episode's first frame: the vehicle that the ego replaces, then the others,
            nearest first, :data:`MOST_VEHICLES` at most; -1 where there are fewer than P.
        steps: [K] frames from there to the end of the scene.
        scene: [K] number of the scene.
        first_start, starts_in: [S] number of a scene's first start, and how many it has.
        lanes, lane_width_m: [S].
    """

    names: tuple[str, ...]
    samples: Tensor
    last: Tensor
    starts: Tensor
    steps: Tensor
    scene: Tensor
    first_start: Tensor
    starts_in: Tensor
    lanes: Tensor
    lane_width_m: Tensor

    @classmethod
    def of(cls, frame: pl.DataFrame, source: str, least_s: float) -> Recordings:
        """From a frame in the schema of :mod:`ganlane.data`, sorted by scene, vehicle and frame.

        Args:
            frame: recorded tracks.
            source: name of the recordings, for messages.
            least_s: an episode starts only where its ego is recorded for so long, s.

        Raises:
            UserError: nobody is recorded for so long.
        """
        widths, counts, tracks = scene_lane_widths(frame), scene_lane_counts(frame), tracks_of_frame(frame)
        begin = _starts(frame, tracks, round(least_s / FRAME_S))
        if len(begin.steps) == 0:
            raise UserError(
                f"{source}: no vehicle is recorded for {least_s:g} s; give longer recordings or a smaller "
                "traffic.least_s."
            )
        scenes, first, scene, number = np.unique(
            begin.scene, return_index=True, return_inverse=True, return_counts=True
        )
        names = tuple(str(name) for name in scenes)
        return cls(
            names,
            samples=torch.from_numpy(_motion(frame, tracks)),
            last=torch.from_numpy(tracks.last),
            starts=torch.from_numpy(begin.starts),
            steps=torch.from_numpy(begin.steps),
            scene=torch.from_numpy(scene),
            first_start=torch.from_numpy(first),
            starts_in=torch.from_numpy(number),
            lanes=torch.tensor([counts[name] for name in names]),
            lane_width_m=torch.tensor([widths[name] for name in names], dtype=torch.float64),
        )


class _Starts(NamedTuple):
    """Fields of :class:`Recordings`, and the name of each start's scene."""

    starts: Integers
    steps: Integers
    scene: NDArray[np.str_]


def _motion(frame: pl.DataFrame, tracks: Tracks) -> Floats:
    """``samples`` of :class:`Recordings`."""
    x, y, speed, length, width = frame.select("x", "y", "speed", "length", "width").to_numpy().T
    index = np.arange(len(x))
    early, late = np.maximum(index - _HALF_WINDOW, tracks.first), np.minimum(index + _HALF_WINDOW, tracks.last)
    heading = np.arctan((y[late] - y[early]) / np.maximum(x[late] - x[early], _LEAST_PATH_M))
    acceleration = (speed[late] - speed[early]) / np.maximum((late - early) * FRAME_S, FRAME_S)
    fastest = np.maximum.reduceat(speed, np.flatnonzero(tracks.begins))[np.cumsum(tracks.begins) - 1]
    desired = np.maximum(fastest, LEAST_DESIRED_SPEED_MPS)
    return np.stack((x, y, heading, speed, acceleration, length, width, desired), axis=1)


def _starts(frame: pl.DataFrame, tracks: Tracks, least: int) -> _Starts:
    """Every frame in which somebody can be replaced; scene by scene, since a scene may be long and busy."""
    last, offset, parts = tracks.last, 0, []
    for rows in frame.partition_by("scene", maintain_order=True):
        starts, steps = _starts_of_scene(rows, last[offset : offset + rows.height] - offset, least)
        parts.append(
            _Starts(np.where(starts < 0, -1, starts + offset), steps, np.repeat(rows["scene"][0], len(steps)))
        )
        offset += rows.height
    widest = max(part.starts.shape[1] for part in parts)
    wide = [np.pad(p.starts, ((0, 0), (0, widest - p.starts.shape[1])), constant_values=-1) for p in parts]
    return _Starts(np.concatenate(wide), *(np.concatenate(field) for field in list(zip(*parts))[1:]))


def _starts_of_scene(rows: pl.DataFrame, last: Integers, least: int) -> tuple[Integers, Integers]:
    """``starts`` and ``steps`` of one scene; samples are counted from its first.

    The ego replaces the vehicle nearest the middle of those that are recorded ``least`` frames on. The middle is the
    median position along the road of all that are recorded in the frame.
    """
    frame, table = _by_frame(rows["frame"].to_numpy())
    there = table >= 0
    x, y = (np.where(there, rows[name].to_numpy()[table], np.nan) for name in ("x", "y"))
    stays = there & (last[table] - table >= least)
    off_middle = np.where(stays, np.abs(x - np.nanmedian(x, axis=1, keepdims=True)), np.inf)
    ego = off_middle.argmin(axis=1)[:, None]
    distance = np.hypot(x - np.take_along_axis(x, ego, 1), y - np.take_along_axis(y, ego, 1))
    np.put_along_axis(distance, ego, -1.0, axis=1)
    order = np.where(there, distance, np.inf).argsort(axis=1, kind="stable")[:, :MOST_VEHICLES]
    possible = stays.any(axis=1)
    return np.take_along_axis(table, order, axis=1)[possible], (frame.max() - frame)[possible]


def _by_frame(frame: Integers) -> tuple[Integers, Integers]:
    """The frame numbers of a scene [F], and the samples in each of them [F, P], -1 where there are fewer than P."""
    order = frame.argsort(kind="stable")
    numbers, first, count = np.unique(frame[order], return_index=True, return_counts=True)
    place = np.arange(count.max())
    table = order[np.minimum(first[:, None] + place, len(order) - 1)]
    return numbers, np.where(place < count[:, None], table, -1)
