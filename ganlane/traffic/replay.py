"""``traffic=replay``: recorded scenes, played around the ego."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ganlane.data import default_scenes, read_scenes
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX, VEHICLE_FLOATS
from ganlane.parameters.driving import IdmParameters, Visibility
from ganlane.parameters.traffic import ReplayParameters
from ganlane.sim.random import Purpose, Stream, episode_key, uniform
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.recordings import Recordings

_X, _LENGTH = VEHICLE_FLOATS.index("x"), VEHICLE_FLOATS.index("length")


class ReplayTraffic(TrafficModule):
    """Plays recorded tracks as they were driven: **nobody reacts to the ego**.

    The ego takes the place of the recorded vehicle nearest the middle of the frame in which the episode starts, with
    its position, speed and size; the M - 1 nearest to it are its neighbours for the whole episode, fewer where fewer
    were recorded. A neighbour whose track ends is no longer valid; the episode ends where the scene ends. Lanes and
    lane width are the scene's, so they differ from row to row (:meth:`road_of`).

    Which scene and which start an episode takes follows from its key, that is from (stream, seed, episode), and so
    does everything else: there is no memory. Scenes are equally likely, whatever their length.

    Args:
        stream: as for every traffic module.
        path: what :func:`ganlane.data.read_scenes` reads; by default the US-101 scenes of the recordings' folder.
        least_s: the replaced vehicle is recorded at least so long from the start on, s, so an episode can last.
        recordings: tensors in place of a file.

    Raises:
        UserError: no recordings, a damaged file, or nobody is recorded for ``least_s``.
    """

    visibility = Visibility.BODY
    #: Lanes and lane width come from :meth:`road_of`, row by row.
    own_roads = True

    def __init__(
        self,
        stream: int = Stream.TRAIN,
        path: str | Path | None = None,
        least_s: float = ReplayParameters.least_s,
        recordings: Recordings | None = None,
    ) -> None:
        self.source = "recordings" if recordings else str(path or _found())
        recorded = recordings or Recordings.of(read_scenes(self.source), self.source, least_s)
        # Sizes for all rows together; the road of a row is road_of's.
        super().__init__(Road(int(recorded.lanes.max()), float(recorded.lane_width_m.mean())), stream)
        self.scene_names = recorded.names
        for name, value in vars(recorded).items():
            if isinstance(value, Tensor):
                self.register_buffer(f"_{name}", value, persistent=False)

    @property
    def longest_m(self) -> float:
        """Length of the longest recorded vehicle, m."""
        return float(self._samples[:, _LENGTH].max())

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
        """Physics steps until the scene ends, [N] int64: the episode is truncated (``scene_end``) after them."""
        return self._steps[self.start_of(key)]

    def road_of(self, key: Tensor, dtype: torch.dtype = torch.float32) -> Road:
        """The road of each row: ``lanes`` [N, 1] int64 and ``lane_width_m`` [N, 1]."""
        scene = self.scene_of(key)[:, None]
        return Road(self._lanes[scene], self._lane_width_m[scene].to(dtype))

    def recorded(self, key: Tensor, step: Tensor, vehicles: int, dtype: torch.dtype) -> Vehicles:
        """The vehicles [N, ``vehicles``] as recorded ``step`` [N] steps after the start; x is 0 where the ego began.

        One whose track has ended stays where it was last seen, and is not valid. Entries without a vehicle are copies
        of the ego's place, not valid either.
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
        fields = torch.cat((fields[..., : _X + 1] - self._samples[own][..., _X, None], fields[..., _X + 1 :]), dim=-1)
        values = dict(zip(VEHICLE_FLOATS, fields.to(dtype).unbind(-1)))
        lane = self.road_of(key, dtype).lane_of(values["y"]).long()
        seen = torch.full_like(lane, int(self.visibility))
        return Vehicles(**values, target_lane=lane, visibility=seen, valid=valid)

    def scenes(
        self, vehicles: int, ego_visibility: int = Visibility.BODY, ego_desired_speed_mps: float = 25.0
    ) -> RecordedScenes:
        """Where episodes of this traffic start."""
        return RecordedScenes(self, vehicles, ego_visibility, ego_desired_speed_mps)

    def move(self, vehicles: Vehicles, memory: dict[str, Tensor], key: Tensor, step: Tensor) -> tuple[Vehicles, dict]:
        """The next recorded frame."""
        moved = self.recorded(key, step + 1, vehicles.x.shape[1], vehicles.x.dtype)
        return moved.with_first(vehicles.at(EGO_INDEX)), memory


@dataclass(frozen=True)
class RecordedScenes:
    """The first scenes of replayed episodes, as the environment asks for them (:class:`ganlane.sim.scenes.Scenes`).

    Attributes:
        traffic: whose recordings.
        vehicles: M, the ego included.
        ego_visibility, ego_desired_speed_mps: of the ego; the recorded driver's are not known.
    """

    traffic: ReplayTraffic
    vehicles: int = 9
    ego_visibility: int = Visibility.BODY
    ego_desired_speed_mps: float = 25.0

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle that was recorded, m."""
        return self.traffic.longest_m

    def check(self, road: Road, idm: IdmParameters) -> None:
        """Anything that was recorded will do."""

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """Vehicles [N, M] at the start of the episodes with ``key`` [N]; the ego at index 0 and x = 0."""
        scene = self.traffic.recorded(key, torch.zeros_like(key), self.vehicles, dtype)
        is_ego = torch.arange(self.vehicles, device=key.device) == EGO_INDEX
        return scene.with_(
            desired_speed=torch.where(is_ego, self.ego_desired_speed_mps, scene.desired_speed),
            visibility=torch.where(is_ego, int(self.ego_visibility), scene.visibility),
        )


def _one_of(u: Tensor, count: Tensor) -> Tensor:
    """A number from 0 to ``count`` - 1, int64, by a uniform ``u`` in [0, 1)."""
    return torch.minimum((u * count).long(), count - 1)


def _found() -> Path:
    """The recordings where no path is given."""
    try:
        return default_scenes()
    except UserError as missing:
        raise UserError(str(missing).replace("data.path", "traffic.path")) from missing
