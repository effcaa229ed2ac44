"""A scene set by hand: vehicles in rows of plain numbers, the same in every episode or with small variations."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.parameters.driving import IdmParameters, Visibility
from ganlane.sim.random import Purpose, uniform
from ganlane.sim.road import Road
from ganlane.sim.scene_checks import check_braking, check_drive, check_overlaps, check_rows
from ganlane.sim.vehicles import Vehicles

STRAIGHT = Road()


@dataclass(frozen=True)
class SceneVehicle:
    """One vehicle of a scene set by hand. m, m/s.

    Args:
        x_m: centre of the body along the road; only distances count, since the ego is moved to x = 0.
        lane: it stands in the middle of this lane, 0 the rightmost; with ``y_m`` given it may be left out.
        y_m: centre of the body across the road, where it is not that of a lane.
        desired_speed_mps: a standing vehicle that shall not drive on has next to none (0.001).
        target_lane: the lane it keeps or is moving to; None: the one that it stands in.
        visibility: who sees its lane changes; None: as the scene has it for the ego and for the others.
        origin: where it is written, for messages ("line 3").
    """

    x_m: float
    lane: int | None = None
    speed_mps: float = 0.0
    desired_speed_mps: float = 25.0
    y_m: float | None = None
    length_m: float = 4.5
    width_m: float = 2.5
    target_lane: int | None = None
    visibility: Visibility | None = None
    origin: str = field(default="", compare=False)

    def y_on(self, road: Road) -> float:
        """Centre of the body across the road, m."""
        if self.y_m is not None:
            return float(self.y_m)
        return float(self.lane or 0) * float(road.lane_width_m)

    def lane_on(self, road: Road) -> int:
        """The lane whose centre is nearest."""
        return int(road.lane_of(torch.tensor(self.y_on(road), dtype=torch.float64)))


@dataclass(frozen=True)
class FixedScene:
    """The same scene in every episode, or with small variations; the first vehicle is the ego.

    Args:
        rows: the vehicles; the ego's x becomes 0, and the others keep their distance to it.
        road: that they stand on; straight, one for all episodes.
        jitter_m: the others' x varies by up to so much to either side from episode to episode, m.
        jitter_mps: everybody's speed, likewise, never below 0; who stands goes on standing. Both follow from
            (stream, seed, episode) alone.
        ego_visibility, others_visibility: of the vehicles that say nothing of it.
        name: of the scene, for messages.

    Raises:
        UserError: a vehicle is off the road, has an impossible number, or overlaps another; :meth:`check` adds those
            scenes from which nobody could drive on.
    """

    rows: tuple[SceneVehicle, ...]
    road: Road = STRAIGHT
    jitter_m: float = 0.0
    jitter_mps: float = 0.0
    ego_visibility: int = Visibility.BODY
    others_visibility: int = Visibility.SIGNALLED
    name: str = "scene"

    def __post_init__(self) -> None:
        check_rows(self)
        check_overlaps(self)

    @property
    def vehicles(self) -> int:
        """M, the ego included."""
        return len(self.rows)

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle, m."""
        return max(row.length_m for row in self.rows)

    def check(self, road: Road, idm: IdmParameters) -> None:
        """Raise :class:`UserError` where ``road`` is another than the scene's, or somebody cannot brake in time."""
        mine, other = ((r.lanes, r.lane_width_m) for r in (self.road, road))
        if mine != other or road.ring_m is not None:
            raise UserError(
                f"{self.name}: laid out for a straight road of {mine[0]} lanes of {mine[1]:g} m, the traffic's has "
                f"{other[0]} of {other[1]} m{' and is a ring' if road.ring_m else ''}; give both the same road."
            )
        check_braking(self, idm)
        check_drive(self, idm)

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """The scene once per key [N], varied by the jitter."""
        base = self.base(dtype, key.device)
        n, m = key.shape[0], self.vehicles
        whole = Vehicles(*(value.expand(n, m).clone() for value in base.as_dict().values()))
        if self.jitter_m == 0 and self.jitter_mps == 0:
            return whole
        u = 2.0 * uniform(key, 0, m, [Purpose.SPAWN_POSITION, Purpose.SPAWN_SPEED], dtype) - 1.0
        is_ego = torch.arange(m, device=key.device) == 0
        x = torch.where(is_ego, whole.x, whole.x + self.jitter_m * u[..., 0])
        varied = (whole.speed + self.jitter_mps * u[..., 1]).clamp_min(0.0)
        return whole.with_(x=x, speed=torch.where(whole.speed > 0, varied, whole.speed))

    def base(self, dtype: torch.dtype = torch.float64, device: torch.device | None = None) -> Vehicles:
        """The scene without jitter, fields [1, M]."""
        rows, road = self.rows, self.road

        def column(values: list[float], kind: torch.dtype = dtype) -> Tensor:
            return torch.tensor([values], dtype=kind, device=device)

        lanes = [row.lane_on(road) for row in rows]
        zero = column([0.0] * len(rows))
        return Vehicles(
            x=column([row.x_m - rows[0].x_m for row in rows]),
            y=column([row.y_on(road) for row in rows]),
            heading=zero,
            speed=column([row.speed_mps for row in rows]),
            acceleration=zero,
            length=column([row.length_m for row in rows]),
            width=column([row.width_m for row in rows]),
            desired_speed=column([row.desired_speed_mps for row in rows]),
            target_lane=column(
                [lane if row.target_lane is None else row.target_lane for row, lane in zip(rows, lanes, strict=True)],
                torch.int64,
            ),
            visibility=column([int(self._seen(index)) for index in range(len(rows))], torch.int64),
            valid=torch.ones_like(zero, dtype=torch.bool),
        )

    def _seen(self, index: int) -> int:
        own = self.rows[index].visibility
        usual = self.ego_visibility if index == 0 else self.others_visibility
        return usual if own is None else own

    def label(self, index: int) -> str:
        """How a message names a vehicle: ``the ego``, ``vehicle 3 (line 5)``."""
        name = "the ego" if index == 0 else f"vehicle {index}"
        origin = self.rows[index].origin
        return f"{name} ({origin})" if origin else name
