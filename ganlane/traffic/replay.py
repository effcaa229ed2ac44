"""``traffic=replay``: recorded scenes, played around the ego.

All samples are in one table. A sample is one vehicle in one frame; the samples of a track follow
each other, 0.1 s apart, so ``k`` steps after sample ``s`` the vehicle is at sample ``s + k``, as
long as its track lasts.

Shapes: R samples, S scenes, and K starts of episodes with up to P vehicles each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import torch
from torch import Tensor

from ganlane.data import (
    FRAME_S,
    default_scenes,
    read_scenes,
    scene_lane_counts,
    scene_lane_widths,
    tracks_of_frame,
)
from ganlane.errors import UserError, did_you_mean
from ganlane.keys import EGO_INDEX, VEHICLE_FLOATS
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.settings.road import LaneStretch
from ganlane.settings.traffic import ReplayTrafficConfig
from ganlane.sim.idm import following_acceleration
from ganlane.sim.lane_ends import from_start, stretches_of_roads
from ganlane.sim.neighbours import perceive
from ganlane.sim.random import Purpose, Stream, episode_key, uniform
from ganlane.sim.scene_files import read_roads
from ganlane.sim.state import Road, RowStretches, Vehicles
from ganlane.traffic.base import Memory, Moved, TrafficModule

#: Vehicles kept at a start, the ego included: more than anybody simulates around one ego.
MOST_VEHICLES = 128
#: Heading and acceleration are taken over this many frames before and after (half a second), or
#: those of the track.
_HALF_WINDOW = 5
#: A vehicle that moves less than this in the window keeps its heading along the road, m.
_LEAST_PATH_M = 1.0
_X = VEHICLE_FLOATS.index("x")
#: Harder braking of the ego at once makes a start one that is not driven by
#: :meth:`ReplayTraffic.episodes_once`, m/s2.
HARD_BRAKING_MPS2 = -4.0
#: Lower bound of a recorded driver's desired speed, m/s (it may be stopped in a jam all the time).
LEAST_DESIRED_SPEED_MPS = 10.0


def _with_tracks(frame: pl.DataFrame, lane_widths: dict[str, float]) -> pl.DataFrame:
    """The samples with their ``index`` and their track's ``first`` and ``last`` one.

    ``fastest`` is its highest speed, m/s. A missing frame ends a track.
    """
    tracks = tracks_of_frame(frame, lane_widths)
    return frame.with_columns(
        index=pl.int_range(pl.len(), dtype=pl.Int64),
        first=pl.Series(tracks.first),
        last=pl.Series(tracks.last),
    ).with_columns(fastest=pl.col("speed").max().over("first"))


def _motion(samples: pl.DataFrame) -> Tensor:
    """The float fields of every sample, [R, 8] float64, ordered as ``VEHICLE_FLOATS``."""
    x = samples["x"].to_numpy()
    y = samples["y"].to_numpy()
    speed = samples["speed"].to_numpy()
    index = samples["index"].to_numpy()

    # The window, as positions in the table, clipped to the vehicle's own track.
    early = np.maximum(index - _HALF_WINDOW, samples["first"].to_numpy())
    late = np.minimum(index + _HALF_WINDOW, samples["last"].to_numpy())
    # It is shorter at a track's ends, and a single sample has none.
    window_s = np.maximum((late - early) * FRAME_S, FRAME_S)
    along_m = np.maximum(x[late] - x[early], _LEAST_PATH_M)

    fields = {
        "x": x,
        "y": y,
        "heading": np.arctan((y[late] - y[early]) / along_m),
        "speed": speed,
        "acceleration": (speed[late] - speed[early]) / window_s,
        "length": samples["length"].to_numpy(),
        "width": samples["width"].to_numpy(),
        "desired_speed": np.maximum(samples["fastest"].to_numpy(), LEAST_DESIRED_SPEED_MPS),
    }
    columns = [fields[name] for name in VEHICLE_FLOATS]
    return torch.from_numpy(np.stack(columns, axis=1))


def _starts(samples: pl.DataFrame, least: int) -> tuple[pl.DataFrame, Tensor]:
    """Every frame with a vehicle that can be replaced: a possible start of an episode.

    The ego replaces the vehicle nearest the middle of those that are recorded ``least`` frames on.
    The middle is the median position along the road of all that are recorded in the frame.

    Args:
        samples: of :func:`_with_tracks`.
        least: frames that the replaced vehicle has to be recorded after the start.

    Returns:
        ``scene`` and ``steps`` (frames to the end of the scene) of the K starts, and the samples
        [K, P] in their first frame: the vehicle that the ego replaces, then the others, nearest
        first, at most :data:`MOST_VEHICLES`; -1 where there are fewer.
    """
    x = pl.col("x")
    index = pl.col("index")
    frame = pl.col("frame")
    # All samples of one moment are a possible start.
    moment = ["scene", "frame"]

    # Ego vehicles come from the middle, where others are recorded on both sides.
    middle = x.quantile(0.5, "midpoint").over(moment)
    there = samples.with_columns(
        stays=pl.col("last") - index >= least,
        off_middle=(x - middle).abs(),
    )

    # The index of the vehicle that the ego replaces. Who does not stay comes last; of two equally
    # near the one with the lower index is first.
    nearness = pl.when("stays").then("off_middle")
    nearest = index.sort_by(nearness, index, nulls_last=True).first()
    there = there.with_columns(
        ego=nearest.over(moment),
        steps=frame.max().over("scene") - frame,
    )
    there = there.filter(pl.col("stays").any().over(moment))

    # Distance from the vehicle that the ego replaces, m.
    place = there["index"].to_numpy()
    ego = there["ego"].to_numpy()
    x_m = samples["x"].to_numpy()
    y_m = samples["y"].to_numpy()
    distance = np.hypot(x_m[place] - x_m[ego], y_m[place] - y_m[ego])
    # Below every distance, so that this vehicle itself comes first.
    distance[place == ego] = -1.0

    # Starts are numbered scene by scene in order of time, their vehicles nearest first.
    there = there.with_columns(distance=distance)
    there = there.sort("scene", "frame", "distance", "index")
    there = there.with_columns(
        start=pl.struct(moment).rle_id(),
        rank=pl.int_range(pl.len()).over(moment),
    )
    there = there.filter(pl.col("rank") < MOST_VEHICLES)

    # One row per start, one column per rank.
    starts = there.filter(pl.col("rank") == 0)
    table = np.full((len(starts), there.n_unique("rank")), -1)
    table[there["start"], there["rank"]] = there["index"]
    return starts, torch.from_numpy(table)


class ReplayTraffic(TrafficModule):
    """Plays recorded tracks as they were driven: **no vehicle reacts to the ego**.

    The ego replaces the recorded vehicle nearest the middle of the episode's first frame, with its
    position, speed and size; the M - 1 nearest to it (or fewer) are its neighbours for the whole
    episode. A neighbour whose track ends is no longer valid; the episode ends with the scene.
    Lanes, lane width, and where ``roads`` says so the ends of lanes, are the scene's, so they
    differ between rows (:meth:`road_of`).

    Scene and start of an episode follow from its key, that is from (stream, seed, episode), so
    there is no memory. Scenes are equally likely, whatever their length.

    Args:
        stream: as for every traffic module.
        path, least_s, roads: see :class:`~ganlane.settings.traffic.ReplayTrafficConfig`.
        recordings: in place of a file, tracks in the schema of :mod:`ganlane.data`, sorted by
            scene, vehicle and frame.

    Attributes:
        scene_names: of the S scenes.

    Raises:
        UserError: no recordings, a damaged file, no vehicle is recorded for ``least_s``, or the
            roads of other scenes or with other numbers of lanes.
    """

    visibility = Visibility.BODY
    own_roads = True

    # Of every sample: its float fields, ordered as VEHICLE_FLOATS, [R, 8] float64, and the last
    # sample of its track, [R].
    samples: Tensor
    last: Tensor

    # Of every start of an episode: the samples in its first frame, [K, P], the steps to its end,
    # [K], and its scene, [K].
    starts: Tensor
    steps: Tensor
    scene: Tensor

    # Of every scene, [S]: its first start, its number of starts, and its road.
    first_start: Tensor
    starts_in: Tensor
    lanes: Tensor
    lane_width_m: Tensor
    # [S, 5, L], the fields of RowStretches by positions of the recordings; None: all lanes go on.
    stretches: Tensor | None

    def __init__(
        self,
        stream: int = Stream.TRAIN,
        path: str | Path | None = None,
        least_s: float = ReplayTrafficConfig.least_s,
        recordings: pl.DataFrame | None = None,
        roads: str | Path | None = None,
    ) -> None:
        if recordings is None:
            self.source = str(path or _default_path())
            frame = read_scenes(self.source)
        else:
            self.source = "recordings"
            frame = recordings

        widths = scene_lane_widths(frame)
        samples = _with_tracks(frame, widths)
        starts, table = _starts(samples, round(least_s / FRAME_S))
        if len(starts) == 0:
            raise UserError(
                f"{self.source}: no vehicle is recorded for {least_s:g} s; give longer recordings "
                "or a smaller traffic.least_s."
            )

        # Starts are sorted by scene, so those of a scene follow each other.
        names, first_start, scene, starts_in = np.unique(
            starts["scene"].to_numpy().astype(str),
            return_index=True,
            return_inverse=True,
            return_counts=True,
        )
        scene_names = tuple(names.tolist())

        counts = scene_lane_counts(frame)
        lanes = torch.tensor([counts[name] for name in scene_names])
        width_m = torch.tensor([widths[name] for name in scene_names], dtype=torch.float64)
        # For sizes only; the road of a row is road_of's.
        road = Road(int(lanes.max()), float(width_m.mean()))
        super().__init__(road, stream)
        self.scene_names = scene_names
        buffers = {
            "samples": _motion(samples),
            "last": samples["last"].to_torch(),
            "starts": table,
            "steps": starts["steps"].to_torch(),
            "scene": torch.from_numpy(scene),
            "first_start": torch.from_numpy(first_start),
            "starts_in": torch.from_numpy(starts_in),
            "lanes": lanes,
            "lane_width_m": width_m,
            "stretches": None if roads is None else self._stretches(roads, counts),
        }
        # Not saved with an agent or a run: they are those of the file.
        for name, tensor in buffers.items():
            self.register_buffer(name, tensor, persistent=False)

    def _stretches(self, path: str | Path, lanes: Mapping[str, int]) -> Tensor:
        """Where the scenes' lanes begin and end by the file ``path``, [S, 5, L].

        ``lanes`` counts the lanes of every scene. Those of a scene that the file leaves out go on.

        Raises:
            UserError: the roads of other scenes or with other numbers of lanes.
        """
        roads = read_roads(path)
        for name, stretches in roads.items():
            if name not in lanes:
                raise UserError(
                    f"{path}: no scene {name} in {self.source}{did_you_mean(name, lanes)}; "
                    "remove it."
                )
            if len(stretches) != lanes[name]:
                raise UserError(
                    f"{path}: {name}: {len(stretches)} lanes; expected the {lanes[name]} of the "
                    "recording, from the right."
                )

        # By default a lane has no ends.
        by_scene = {name: (LaneStretch(),) * count for name, count in lanes.items()}
        by_scene |= roads
        of_scenes = [by_scene[name] for name in self.scene_names]
        return torch.stack(stretches_of_roads(of_scenes), dim=1)

    def start_of(self, key: Tensor) -> Tensor:
        """Number of the start, [N] int64, of the episodes with ``key`` [N]."""
        # First the scene, then a start in it: long scenes are not driven more often.
        # Two vehicles' numbers serve as two independent ones.
        u = uniform(key, 0, 2, [Purpose.REPLAY_START], torch.float64)[..., 0]
        u_scene, u_start = u.unbind(-1)
        scene = _one_of(u_scene, torch.full_like(key, len(self.scene_names)))
        start_in_scene = _one_of(u_start, self.starts_in[scene])
        return self.first_start[scene] + start_in_scene

    def scenes_of_episodes(self, seed: int, episodes: Sequence[int]) -> list[str]:
        """Name of the scene of each of the ``episodes`` with ``seed``, for figures by scene."""
        starts = self.start_of(self._keys_of(seed, episodes))
        scenes = self.scene[starts].tolist()
        return [self.scene_names[number] for number in scenes]

    def cars_of_episodes(self, seed: int, episodes: Sequence[int]) -> list[int]:
        """A number for the recorded car that the ego replaces in each of ``episodes``.

        Episodes of one car begin a tenth of a second apart: they are near copies of each other.
        """
        starts = self.start_of(self._keys_of(seed, episodes))
        replaced = self.starts[starts, 0]
        # The last sample of its track is nobody else's.
        return self.last[replaced].tolist()

    def episodes_once(self, seed: int, idm: IdmParameters) -> list[int]:
        """The first episode of each start that can be driven, in ascending order.

        Every start is driven once. Left out are those at which the ego, which follows by ``idm``,
        would brake beyond :data:`HARD_BRAKING_MPS2` at once: the recorded driver was nearer to the
        vehicle ahead than IDM ever is, and a crash there is none of the agent's.

        Args:
            seed: of the episodes.
            idm: the ego's.

        Raises:
            UserError: no start is left.
        """
        # Scenes are equally likely, so a start of the longest scene comes once in so many episodes:
        # in 20 times as many hardly any start is missing.
        rarest = len(self.scene_names) * int(self.starts_in.max())
        starts = self.start_of(self._keys_of(seed, range(20 * rarest)))
        _, first = np.unique(starts.cpu().numpy(), return_index=True)
        episodes = np.sort(first)

        # What the ego alone, vehicle 0, would do in the first frame of each.
        key = self._keys_of(seed, episodes.tolist())
        vehicles = self.scenes(MOST_VEHICLES)(key, torch.float32)
        scene = perceive(vehicles, self.road_of(key), slice(0, 1))
        acceleration = following_acceleration(scene, idm)[:, 0]
        brakes_softly = acceleration >= HARD_BRAKING_MPS2
        if not brakes_softly.any():
            raise UserError(
                f"{self.source}: at every start the ego would have to brake harder than "
                f"{-HARD_BRAKING_MPS2:g} m/s2 at once; give other recordings."
            )
        return episodes[brakes_softly.cpu().numpy()].tolist()

    def _keys_of(self, seed: int, episodes: Sequence[int]) -> Tensor:
        """Keys [E] int64 of the ``episodes`` of this traffic's stream."""
        numbers = torch.tensor(list(episodes), dtype=torch.int64, device=self.scene.device)
        return episode_key(self.stream, torch.full_like(numbers, seed), numbers)

    def steps_of(self, key: Tensor) -> Tensor:
        """Physics steps until the scene ends, [N] int64.

        The episode is truncated (``scene_end``) after them.
        """
        return self.steps[self.start_of(key)]

    def road_of(self, key: Tensor, dtype: torch.dtype = torch.float32) -> Road:
        """The road of each row; x = 0 is the ego's start.

        Args:
            key: of the episodes, [N] int64.
            dtype: float type of the run.

        Returns:
            A road with ``lanes`` [N, 1] int64, ``lane_width_m`` [N, 1], and where its lanes begin
            and end [N, L].
        """
        start = self.start_of(key)
        scene = self.scene[start]

        stretches = None
        if self.stretches is not None:
            # From the positions of the recording to those of the episode.
            of_scenes = RowStretches(*self.stretches[scene].unbind(1))
            ego_m = self.samples[self.starts[start, :1], _X]
            stretches = from_start(of_scenes, ego_m, dtype)

        return Road(
            self.lanes[scene][:, None],
            self.lane_width_m[scene][:, None].to(dtype),
            row_stretches=stretches,
        )

    def recorded(self, key: Tensor, step: Tensor, vehicles: int, dtype: torch.dtype) -> Vehicles:
        """The vehicles as recorded ``step`` steps after the start; x = 0 is the ego's start.

        A vehicle whose track has ended stays at its last position and is invalid. Entries without a
        vehicle are invalid copies of the ego's start.

        Args:
            key: of the episodes, [N] int64.
            step: physics steps since their starts, [N] int64.
            vehicles: M, the ego included.
            dtype: float type of the run.

        Returns:
            Vehicles [N, M], the one that the ego replaces first.
        """
        start = self.start_of(key)
        first = self.starts[start, :vehicles]
        # Fewer vehicles than asked for: the rest of the row is invalid.
        lacking = first.new_full((len(key), vehicles - first.shape[1]), -1)
        first = torch.cat((first, lacking), dim=1)
        is_recorded = first >= 0

        # Samples follow each other in the table, so a step is one sample further.
        ego = self.starts[start, :1]
        begin = torch.where(is_recorded, first, ego)
        last = self.last[begin]
        now = begin + step[:, None]
        fields = self.samples[torch.minimum(now, last)]

        # In float64, as far down the road as recordings go; only then in the run's float type.
        fields[..., _X] -= self.samples[ego][..., _X]
        values = dict(zip(VEHICLE_FLOATS, fields.to(dtype).unbind(-1)))

        lane = self.road_of(key, dtype).lane_of(values["y"]).long()
        return Vehicles(
            **values,
            target_lane=lane,
            visibility=torch.full_like(lane, int(self.visibility)),
            valid=is_recorded & (now <= last),
        )

    def scenes(
        self,
        vehicles: int,
        ego_visibility: int = Visibility.BODY,
        ego_desired_speed_mps: float = 25.0,
    ) -> RecordedScenes:
        """The initial scenes of this traffic; the arguments are those of
        :class:`RecordedScenes`.
        """
        return RecordedScenes(self, vehicles, ego_visibility, ego_desired_speed_mps)

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """The next recorded frame."""
        moved = self.recorded(key, step + 1, vehicles.x.shape[1], vehicles.x.dtype)
        # The ego is driven by the environment, not by the recording.
        return moved.with_first(vehicles.at(EGO_INDEX)), memory


@dataclass(frozen=True)
class RecordedScenes:
    """The initial scenes of replayed episodes (:class:`ganlane.sim.scenes.Scenes`).

    Attributes:
        traffic: that is played.
        vehicles: M, the ego included.
        ego_visibility: when others see the ego's lane changes
            (:class:`~ganlane.settings.driving.Visibility`). This and what follows is not known of
            the recorded driver.
        ego_desired_speed_mps: of the ego.
    """

    traffic: ReplayTraffic
    vehicles: int
    ego_visibility: int
    ego_desired_speed_mps: float

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle that was recorded, m."""
        return float(self.traffic.samples[:, VEHICLE_FLOATS.index("length")].max())

    def check(self, road: Road, idm: IdmParameters) -> None:
        """Recorded scenes are not checked."""

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """Vehicles [N, M] at the start of the episodes with ``key`` [N].

        The ego at index 0 and x = 0.
        """
        scene = self.traffic.recorded(key, torch.zeros_like(key), self.vehicles, dtype)
        is_ego = scene.is_ego()
        desired_speed = torch.where(is_ego, self.ego_desired_speed_mps, scene.desired_speed)
        visibility = torch.where(is_ego, int(self.ego_visibility), scene.visibility)
        return scene.with_(desired_speed=desired_speed, visibility=visibility)


def _one_of(u: Tensor, count: Tensor) -> Tensor:
    """A number from 0 to ``count`` - 1, int64, from a uniform ``u`` in [0, 1)."""
    number = (u * count).long()
    # The product may round up to count.
    return torch.minimum(number, count - 1)


def _default_path() -> Path:
    """The default recordings."""
    try:
        return default_scenes()
    except UserError as missing:
        raise UserError(str(missing).replace("data.path", "traffic.path")) from missing
