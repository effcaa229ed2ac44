"""Hand-made initial scenes: the same vehicles in every episode, optionally with small random variations."""

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
    """One vehicle of a hand-made scene. m, m/s.

    Args:
        x_m: centre of the body along the road; only distances matter, since the scene is shifted to ego x = 0.
        lane: the vehicle is at the centre of this lane, 0 the rightmost; may be left out if ``y_m`` is given.
        y_m: centre of the body across the road, if it is not a lane's centre.
        desired_speed_mps: above 0; 0.001 for a vehicle that stays stopped.
        target_lane: the lane it keeps or is moving to; None: the lane it is in.
        visibility: when others see its lane changes; None: the scene's ``ego_visibility`` or ``others_visibility``.
        origin: place in its file, for messages ("line 3").
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
    """The same initial scene in every episode, or with small random variations; the first vehicle is the ego.

    Args:
        rows: the vehicles; the ego's x becomes 0, and the others keep their distance to it. road: the road;
        straight, the same in all episodes. jitter_m: largest random shift of the others' x, forwards or backwards,
        per episode, m. jitter_mps: largest random change of each speed, m/s, never below 0; stopped vehicles stay
        stopped. Both depend
            on (stream, seed, episode) only.
        ego_visibility, others_visibility: for vehicles without a visibility of their own.
        name: of the scene, for messages.

    Raises:
        UserError: a vehicle is off the road, has an impossible number, or overlaps another; :meth:`check` also raises
            it for scenes in which crashes are unavoidable.
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
        """Raise :class:`UserError` if ``road`` differs from the scene's, or a vehicle cannot brake in time."""
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
        """Name of a vehicle in messages: ``the ego``, ``vehicle 3 (line 5)``."""
        name = "the ego" if index == 0 else f"vehicle {index}"
        origin = self.rows[index].origin
        return f"{name} ({origin})" if origin else name
