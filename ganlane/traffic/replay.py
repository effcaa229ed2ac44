"""``traffic=replay``: recorded scenes, played around the ego.

All samples are in one table. A sample is one vehicle in one frame; the samples of a track follow
each other, 0.1 s apart, so ``k`` steps after sample ``s`` the vehicle is at sample ``s + k``, as
long as its track lasts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray
from torch import Tensor

from ganlane.data import (
    FRAME_S,
    Tracks,
    default_scenes,
    read_scenes,
    scene_lane_counts,
    scene_lane_widths,
    tracks_of_frame,
)
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX, VEHICLE_FLOATS
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.settings.traffic import ReplayTrafficConfig
from ganlane.sim.random import Purpose, Stream, episode_key, uniform
from ganlane.sim.state import Road, Vehicles
from ganlane.traffic.base import Memory, Moved, TrafficModule

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Vehicles kept at a start, the ego included: more than anybody simulates around one ego.
MOST_VEHICLES = 128
#: Heading and acceleration are taken over this many frames before and after (half a second), or
#: those of the track.
_HALF_WINDOW = 5
#: A vehicle that moves less than this in the window keeps its heading along the road, m.
_LEAST_PATH_M = 1.0
_X = VEHICLE_FLOATS.index("x")
#: Lower bound of a recorded driver's desired speed, m/s (it may be stopped in a jam all the time).
LEAST_DESIRED_SPEED_MPS = 10.0


@dataclass(frozen=True)
class Recordings:
    """Recorded scenes as tensors: R samples of S scenes, and K possible starts of episodes.

    Attributes:
        names: of the S scenes.
        samples: [R, 8] float64, the float fields of ``vehicles`` ordered as in
            ``ganlane.keys.VEHICLE_FLOATS``.
        last: [R] the last sample of each sample's track.
        starts: [K, P] samples in an episode's first frame: the vehicle that the ego replaces, then
            the others, nearest first, at most :data:`MOST_VEHICLES`; -1 if there are fewer than P.
        steps: [K] frames from there to the end of the scene.
        scene: [K] number of the scene.
        first_start, starts_in: [S] number of a scene's first start, and its number of starts.
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
        """From tracks in the schema of :mod:`ganlane.data`, sorted by scene, vehicle and frame.

        The ego of an episode is recorded for ``least_s`` at least. ``source`` names the recordings
        in messages.

        Raises:
            UserError: no vehicle is recorded for that time.
        """
        widths, counts, tracks = (
            scene_lane_widths(frame),
            scene_lane_counts(frame),
            tracks_of_frame(frame),
        )
        starts, steps, names_of_starts = _starts(frame, tracks, round(least_s / FRAME_S))
        if len(steps) == 0:
            raise UserError(
                f"{source}: no vehicle is recorded for {least_s:g} s; give longer recordings or a smaller "
                "traffic.least_s."
            )
        scenes, first, scene, number = np.unique(
            names_of_starts, return_index=True, return_inverse=True, return_counts=True
        )
        names = tuple(str(name) for name in scenes)
        return cls(
            names,
            samples=torch.from_numpy(_motion(frame, tracks)),
            last=torch.from_numpy(tracks.last),
            starts=torch.from_numpy(starts),
            steps=torch.from_numpy(steps),
            scene=torch.from_numpy(scene),
            first_start=torch.from_numpy(first),
            starts_in=torch.from_numpy(number),
            lanes=torch.tensor([counts[name] for name in names]),
            lane_width_m=torch.tensor([widths[name] for name in names], dtype=torch.float64),
        )


def _motion(frame: pl.DataFrame, tracks: Tracks) -> Floats:
    """``samples`` of :class:`Recordings`."""
    x, y, speed, length, width = frame.select("x", "y", "speed", "length", "width").to_numpy().T
    index = np.arange(len(x))
    early, late = (
        np.maximum(index - _HALF_WINDOW, tracks.first),
        np.minimum(index + _HALF_WINDOW, tracks.last),
    )
    heading = np.arctan((y[late] - y[early]) / np.maximum(x[late] - x[early], _LEAST_PATH_M))
    acceleration = (speed[late] - speed[early]) / np.maximum((late - early) * FRAME_S, FRAME_S)
    fastest = np.maximum.reduceat(speed, np.flatnonzero(tracks.begins))[
        np.cumsum(tracks.begins) - 1
    ]
    desired = np.maximum(fastest, LEAST_DESIRED_SPEED_MPS)
    return np.stack((x, y, heading, speed, acceleration, length, width, desired), axis=1)


def _starts(
    frame: pl.DataFrame, tracks: Tracks, least: int
) -> tuple[Integers, Integers, NDArray[np.str_]]:
    """``starts`` and ``steps`` of :class:`Recordings`, and the names of their scenes.

    Every frame with a vehicle that can be replaced; scene by scene, which bounds the memory.
    """
    offset, parts = 0, []
    for rows in frame.partition_by("scene", maintain_order=True):
        starts, steps = _starts_of_scene(
            rows, tracks.last[offset : offset + rows.height] - offset, least
        )
        parts.append(
            (
                np.where(starts < 0, -1, starts + offset),
                steps,
                np.repeat(rows["scene"][0], len(steps)),
            )
        )
        offset += rows.height
    starts_of, steps_of, scene_of = zip(*parts)
    widest = max(each.shape[1] for each in starts_of)
    wide = [
        np.pad(each, ((0, 0), (0, widest - each.shape[1])), constant_values=-1)
        for each in starts_of
    ]
    return np.concatenate(wide), np.concatenate(steps_of), np.concatenate(scene_of)


def _starts_of_scene(rows: pl.DataFrame, last: Integers, least: int) -> tuple[Integers, Integers]:
    """``starts`` and ``steps`` of one scene; samples are counted from its first.

    The ego replaces the vehicle nearest the middle of those that are recorded ``least`` frames on.
    The middle is the median position along the road of all that are recorded in the frame.
    """
    by_frame = rows["frame"].to_numpy().argsort(kind="stable")
    frame, first, count = np.unique(
        rows["frame"].to_numpy()[by_frame], return_index=True, return_counts=True
    )
    place = np.arange(count.max())
    # The samples in each frame [F, P], -1 where there are fewer than P.
    table = by_frame[np.minimum(first[:, None] + place, len(by_frame) - 1)]
    table = np.where(place < count[:, None], table, -1)
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


class ReplayTraffic(TrafficModule):
    """Plays recorded tracks as they were driven: **no vehicle reacts to the ego**.

    The ego replaces the recorded vehicle nearest the middle of the episode's first frame, with its
    position, speed and size; the M - 1 nearest to it (or fewer) are its neighbours for the whole
    episode. A neighbour whose track ends is no longer valid; the episode ends with the scene. Lanes
    and lane width are the scene's, so they differ between rows (:meth:`road_of`).

    Scene and start of an episode follow from its key, that is from (stream, seed, episode), so
    there is no memory. Scenes are equally likely, whatever their length.

    Args:
        stream: as for every traffic module.
        path, least_s: see :class:`~ganlane.settings.traffic.ReplayTrafficConfig`.
        recordings: tensors instead of a file.

    Raises:
        UserError: no recordings, a damaged file, or no vehicle is recorded for ``least_s``.
    """

    visibility = Visibility.BODY
    own_roads = True

    def __init__(
        self,
        stream: int = Stream.TRAIN,
        path: str | Path | None = None,
        least_s: float = ReplayTrafficConfig.least_s,
        recordings: Recordings | None = None,
    ) -> None:
        self.source = "recordings" if recordings else str(path or _found())
        recorded = recordings or Recordings.of(read_scenes(self.source), self.source, least_s)
        # For sizes only; the road of a row is road_of's.
        super().__init__(
            Road(int(recorded.lanes.max()), float(recorded.lane_width_m.mean())), stream
        )
        self.scene_names = recorded.names
        for name, value in vars(recorded).items():
            if isinstance(value, Tensor):
                self.register_buffer(f"_{name}", value, persistent=False)

    def start_of(self, key: Tensor) -> Tensor:
        """Number of the start, [N] int64, of the episodes with ``key`` [N]."""
        u = uniform(key, 0, 2, [Purpose.REPLAY_START], torch.float64)[..., 0]
        scene = _one_of(u[:, 0], torch.full_like(key, len(self.scene_names)))
        return self._first_start[scene] + _one_of(u[:, 1], self._starts_in[scene])

    def scene_of(self, key: Tensor) -> Tensor:
        """Number of the scene in :attr:`scene_names`, [N] int64."""
        return self._scene[self.start_of(key)]

    def scenes_of_episodes(self, seed: int, episodes: Sequence[int]) -> list[str]:
        """Name of the scene of each of ``episodes``, for figures by scene."""
        numbers = torch.tensor(list(episodes), dtype=torch.int64, device=self._scene.device)
        key = episode_key(self.stream, torch.full_like(numbers, seed), numbers)
        return [self.scene_names[number] for number in self.scene_of(key).tolist()]

    def steps_of(self, key: Tensor) -> Tensor:
        """Physics steps until the scene ends, [N] int64.

        The episode is truncated (``scene_end``) after them.
        """
        return self._steps[self.start_of(key)]

    def road_of(self, key: Tensor, dtype: torch.dtype = torch.float32) -> Road:
        """The road of each row: ``lanes`` [N, 1] int64 and ``lane_width_m`` [N, 1]."""
        scene = self.scene_of(key)[:, None]
        return Road(self._lanes[scene], self._lane_width_m[scene].to(dtype))

    def recorded(self, key: Tensor, step: Tensor, vehicles: int, dtype: torch.dtype) -> Vehicles:
        """The vehicles [N, ``vehicles``] as recorded ``step`` [N] steps after the start; x = 0 is
        the ego's start.

        A vehicle whose track has ended stays at its last position and is invalid. Entries without a
        vehicle are invalid copies of the ego's start.
        """
        start = self.start_of(key)
        first = self._starts[start, :vehicles]
        missing = vehicles - first.shape[1]
        first = torch.cat((first, first.new_full((len(key), max(missing, 0)), -1)), dim=1)
        own = self._starts[start, :1]
        begin = torch.where(first >= 0, first, own)
        now = begin + step[:, None]
        valid = (first >= 0) & (now <= self._last[begin])
        fields = self._samples[torch.minimum(now, self._last[begin])]
        fields = torch.cat(
            (fields[..., : _X + 1] - self._samples[own][..., _X, None], fields[..., _X + 1 :]),
            dim=-1,
        )
        values = dict(zip(VEHICLE_FLOATS, fields.to(dtype).unbind(-1)))
        lane = self.road_of(key, dtype).lane_of(values["y"]).long()
        seen = torch.full_like(lane, int(self.visibility))
        return Vehicles(**values, target_lane=lane, visibility=seen, valid=valid)

    def scenes(
        self,
        vehicles: int,
        ego_visibility: int = Visibility.BODY,
        ego_desired_speed_mps: float = 25.0,
    ) -> RecordedScenes:
        """The initial scenes of this traffic."""
        return RecordedScenes(self, vehicles, ego_visibility, ego_desired_speed_mps)

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """The next recorded frame."""
        moved = self.recorded(key, step + 1, vehicles.x.shape[1], vehicles.x.dtype)
        return moved.with_first(vehicles.at(EGO_INDEX)), memory


@dataclass(frozen=True)
class RecordedScenes:
    """The initial scenes of replayed episodes (:class:`ganlane.sim.scenes.Scenes`), M ``vehicles``
    with the ego.

    What is said of the ego is not known of the recorded driver.
    """

    traffic: ReplayTraffic
    vehicles: int = 9
    ego_visibility: int = Visibility.BODY
    ego_desired_speed_mps: float = 25.0

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle that was recorded, m."""
        return float(self.traffic._samples[:, VEHICLE_FLOATS.index("length")].max())

    def check(self, road: Road, idm: IdmParameters) -> None:
        """Recorded scenes are not checked."""

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """Vehicles [N, M] at the start of the episodes with ``key`` [N].

        The ego at index 0 and x = 0.
        """
        scene = self.traffic.recorded(key, torch.zeros_like(key), self.vehicles, dtype)
        is_ego = torch.arange(self.vehicles, device=key.device) == EGO_INDEX
        return scene.with_(
            desired_speed=torch.where(is_ego, self.ego_desired_speed_mps, scene.desired_speed),
            visibility=torch.where(is_ego, int(self.ego_visibility), scene.visibility),
        )


def _one_of(u: Tensor, count: Tensor) -> Tensor:
    """A number from 0 to ``count`` - 1, int64, from a uniform ``u`` in [0, 1)."""
    return torch.minimum((u * count).long(), count - 1)


def _found() -> Path:
    """The default recordings."""
    try:
        return default_scenes()
    except UserError as missing:
        keys = "traffic.path=FILE (in evaluate traffics=[{name:replay,path:FILE}])"
        raise UserError(str(missing).replace("data.path=FILE", keys)) from missing
