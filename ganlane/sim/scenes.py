"""Hand-made initial scenes: the same vehicles in every episode, or with small variations.

:class:`Scenes` is the contract; :class:`~ganlane.sim.spawn.RandomScenes` draws scenes by Table II.
Scenes set by hand are checked for impossible numbers, overlaps and unavoidable crashes; errors name
the vehicles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.settings.record import NO_KEY, Record
from ganlane.settings.road import NOTHING
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.dynamics import drive
from ganlane.sim.idm import following_acceleration, needed_deceleration
from ganlane.sim.neighbours import in_lane, perceive
from ganlane.sim.random import Purpose, Stream, episode_key, uniform
from ganlane.sim.state import STRAIGHT, Road, Vehicles

#: Duration of the test drive of :func:`check_drive`, s, and number of episodes with jitter that it
#: simulates.
DRIVE_S = 15.0
DRIVES = 32
#: The most vehicles and lanes of a scene, the largest number in it (m, m/s), and the smallest of
#: those above 0: beyond them float32 is too coarse.
MOST_VEHICLES = 1000
MOST_LANES = 100
LARGEST = 1e6
SMALLEST = 1e-6
#: Distance between vehicles that wait outside at the start, m: nobody sees them there.
SLOT_M = 20.0


class Scenes(Protocol):
    """Makes the initial scene of every episode."""

    @property
    def vehicles(self) -> int:
        """M, the ego included."""
        ...

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle of all episodes, the ego included, m."""
        ...

    def check(self, road: Road, idm: IdmParameters) -> None:
        """Raise :class:`UserError` if it does not fit the road, or crashes are unavoidable."""
        ...

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """The vehicles of the episodes with these keys [N] int64, fields [N, M].

        The ego at index 0 and x = 0.
        """
        ...


@dataclass(frozen=True)
class SceneVehicle(Record):
    """One vehicle of a hand-made scene. m, m/s.

    Attributes:
        x_m: centre of the body along the road; only distances matter, since the scene is shifted to
            ego x = 0.
        lane: the vehicle is at the centre of this lane, 0 the rightmost; may be left out if ``y_m``
            is given.
        y_m: centre of the body across the road, if it is not a lane's centre.
        desired_speed_mps: above 0; 0.001 for a vehicle that stays stopped.
        target_lane: the lane it keeps or is moving to; None: the lane it is in.
        visibility: when others see its lane changes, a :class:`Visibility`; None: the scene's
            ``ego_visibility`` or ``others_visibility``.
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
    visibility: int | None = None
    origin: str = field(default="", compare=False, metadata=NO_KEY)

    def y_on(self, road: Road) -> float:
        """Centre of the body across the road, m."""
        if self.y_m is not None:
            return float(self.y_m)
        return float(self.lane or 0) * float(road.lane_width_m)

    def lane_on(self, road: Road) -> int:
        """The lane whose centre is nearest."""
        return int(road.lane_of(torch.tensor(self.y_on(road), dtype=torch.float64)))


#: Those of a scene, the ego first.
SceneVehicles = tuple[SceneVehicle, ...]


@dataclass(frozen=True)
class FixedScene:
    """The same scene in every episode, or with small variations; the first vehicle is the ego.

    Args:
        rows: the vehicles; the ego's x becomes 0, and the others keep their distance to it.
        road: straight, the same in all episodes.
        jitter_m: largest random shift of the others' x, forwards or backwards, m.
        jitter_mps: largest random change of each speed, m/s, never below 0; stopped vehicles stay
            stopped. Both depend on (stream, seed, episode) only.
        ego_visibility, others_visibility: for vehicles without a visibility of their own.
        name: of the scene, for messages.
        waiting: so many of the last ``rows`` wait outside the road (:mod:`ganlane.sim.flow`).

    Raises:
        UserError: a vehicle is off the road, has an impossible number, or overlaps another;
            :meth:`check` also raises it for scenes in which crashes are unavoidable.
    """

    rows: SceneVehicles
    road: Road = STRAIGHT
    jitter_m: float = 0.0
    jitter_mps: float = 0.0
    ego_visibility: int = Visibility.BODY
    others_visibility: int = Visibility.SIGNALLED
    name: str = "scene"
    waiting: int = 0

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
        """Raise :class:`UserError` if ``road`` is another, or a vehicle cannot brake in time.

        Those who wait outside are out of everybody's way.
        """
        if self.road != road:
            lanes = self.road.lanes
            width = self.road.lane_width_m
            ring = " and is a ring" if road.ring_m else ""
            raise UserError(
                f"{self.name}: laid out for a straight road of {lanes} lanes of {width:g} m, the "
                f"traffic's has {road.lanes} of {road.lane_width_m} m{ring}; give both the same "
                "road."
            )

        on_road = self.rows[: self.vehicles - self.waiting]
        present = replace(self, rows=on_road, waiting=0)
        check_braking(present, idm)
        check_drive(present, idm)

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """The scene once per key [N], varied by the jitter."""
        n = key.shape[0]
        m = self.vehicles
        base = self.base(dtype, key.device)

        # Copied, since the rows of an expanded tensor share memory.
        whole = Vehicles(*(value.expand(n, m).clone() for value in base))
        if self.jitter_m == 0 and self.jitter_mps == 0:
            return whole

        # From [0, 1) to [-1, 1), [N, M, 2].
        purposes = [Purpose.SPAWN_POSITION, Purpose.SPAWN_SPEED]
        u = 2.0 * uniform(key, 0, m, purposes, dtype) - 1.0

        # Only the others are shifted: the ego stays at x = 0.
        x = torch.where(whole.is_ego(), whole.x, whole.x + self.jitter_m * u[..., 0])

        varied = (whole.speed + self.jitter_mps * u[..., 1]).clamp_min(0.0)
        # Who stands remains standing.
        speed = torch.where(whole.speed > 0, varied, whole.speed)
        return whole.with_(x=x, speed=speed)

    def base(
        self,
        dtype: torch.dtype = torch.float64,
        device: torch.device | None = None,
    ) -> Vehicles:
        """The scene without jitter, fields [1, M]."""
        rows = self.rows
        road = self.road

        def row_of(values: Sequence[float], kind: torch.dtype = dtype) -> Tensor:
            """A number of each vehicle as [1, M]."""
            return torch.tensor([values], dtype=kind, device=device)

        # What a row leaves out follows from the scene.
        targets = []
        visibilities = []
        usual = [self.ego_visibility] + [self.others_visibility] * (len(rows) - 1)
        for row, kind in zip(rows, usual):
            targets.append(row.lane_on(road) if row.target_lane is None else row.target_lane)
            visibilities.append(kind if row.visibility is None else row.visibility)

        # Those who wait are the last ones.
        present = len(rows) - self.waiting
        # Vehicles of a scene start straight, at a constant speed.
        zero = row_of([0.0] * len(rows))
        return Vehicles(
            x=row_of([row.x_m - rows[0].x_m for row in rows]),
            y=row_of([row.y_on(road) for row in rows]),
            heading=zero,
            speed=row_of([row.speed_mps for row in rows]),
            acceleration=zero,
            length=row_of([row.length_m for row in rows]),
            width=row_of([row.width_m for row in rows]),
            desired_speed=row_of([row.desired_speed_mps for row in rows]),
            target_lane=row_of(targets, torch.int64),
            visibility=row_of(visibilities, torch.int64),
            valid=torch.arange(len(rows), device=device)[None] < present,
        )

    def label(self, index: int) -> str:
        """Name of a vehicle in messages: ``the ego``, ``vehicle 3 (line 5)``."""
        name = "the ego" if index == 0 else f"vehicle {index}"
        origin = self.rows[index].origin
        return f"{name} ({origin})" if origin else name


def with_waiting(rows: SceneVehicles, road: Road) -> SceneVehicles:
    """``rows``, and with a flow the vehicles that wait outside at the start, one in each slot.

    They are drivers like the others of the scene in turn, beyond the end of the section at their
    desired speeds, in a lane that goes on.
    """
    flow = road.flow
    if flow is None:
        return rows

    ends = [its.end for its in road.stretches]
    lane = ends.index(NOTHING)
    waiting = []
    for slot in range(flow.slots):
        like = rows[1 + slot % (len(rows) - 1)]
        vehicle = replace(
            like,
            x_m=flow.to_m + SLOT_M * (slot + 1),
            y_m=None,
            lane=lane,
            target_lane=lane,
            speed_mps=like.desired_speed_mps,
        )
        waiting.append(vehicle)
    return (*rows, *waiting)


def check_count(name: str, vehicles: int) -> None:
    """Raise :class:`UserError` for more vehicles than a scene may have.

    Every pair of them is looked at.
    """
    if vehicles > MOST_VEHICLES:
        raise UserError(
            f"{name}: {vehicles} vehicles; a scene has at most {MOST_VEHICLES}, remove some."
        )


def check_rows(scene: FixedScene) -> None:
    """Raise :class:`UserError` for fewer than two vehicles, or one with an impossible number."""
    check_count(scene.name, len(scene.rows))
    if len(scene.rows) < 2:
        raise UserError(
            f"{scene.name}: {len(scene.rows)} vehicles; a scene needs the ego and at least one "
            "other."
        )

    lanes = scene.road.lanes
    width = scene.road.lane_width_m
    if not isinstance(lanes, int) or isinstance(width, Tensor):
        raise UserError(
            f"{scene.name}: a scene set by hand needs one road for all episodes, not one per row."
        )
    # Written so that NaN is refused: every comparison with it is false.
    if not (1 <= lanes <= MOST_LANES and SMALLEST <= width <= LARGEST):
        raise UserError(
            f"{scene.name}: a road of {lanes:g} lanes of {width:g} m; "
            f"expected 1 to {MOST_LANES} of at most {LARGEST:g} m."
        )

    if not all(0 <= jitter <= LARGEST for jitter in (scene.jitter_m, scene.jitter_mps)):
        raise UserError(
            f"{scene.name}: jitter_m={scene.jitter_m:g}, jitter_mps={scene.jitter_mps:g}: "
            "expected at least 0."
        )

    for index, row in enumerate(scene.rows):
        fault = _fault(row, scene.road)
        if fault:
            raise UserError(f"{scene.name}: {scene.label(index)}: {fault}.")


def _fault(row: SceneVehicle, road: Road) -> str:
    """What is wrong with one vehicle; empty if nothing is."""
    for name in ("x_m", "y_m", "speed_mps", "desired_speed_mps", "length_m", "width_m"):
        value = getattr(row, name)
        if value is not None and not -LARGEST <= value <= LARGEST:
            return f"{name}={value:g}: expected a number from {-LARGEST:g} to {LARGEST:g}"
    if row.speed_mps < 0:
        return f"speed_mps={row.speed_mps:g}: expected at least 0; vehicles drive forwards only"
    for name in ("desired_speed_mps", "length_m", "width_m"):
        if getattr(row, name) < SMALLEST:
            return f"{name}={getattr(row, name):g}: expected a number above 0"

    # Then the place across the road: on it, in its lane, and next to its target lane.
    lanes = int(road.lanes)
    if row.lane is None and row.y_m is None:
        return "neither lane nor y_m is given; give one of them"
    for name, lane in (("lane", row.lane), ("target_lane", row.target_lane)):
        if lane is not None and not 0 <= lane < lanes:
            return f"{name}={lane}: expected 0 to {lanes - 1}, the road has {lanes} lanes"

    right = float(road.right_edge_m())
    left = float(road.left_edge_m())
    y = row.y_on(road)
    half_m = 0.5 * row.width_m
    # 1e-6 m for rounding.
    if y - half_m < right - 1e-6 or y + half_m > left + 1e-6:
        return (
            f"y={y:g} m, width {row.width_m:g} m: expected on the road, which runs from "
            f"{right:g} to {left:g} m"
        )

    # A lane that contradicts the position would be a lane change nobody asked for.
    here = row.lane_on(road)
    if row.lane is not None and row.lane != here:
        return (
            f"lane={row.lane} and y_m={y:g} contradict each other (that is lane {here}); give one"
        )
    if row.target_lane is not None and abs(row.target_lane - here) > 1:
        return f"target_lane={row.target_lane}: expected a lane next to its own, {here}"
    return ""


def check_overlaps(scene: FixedScene) -> None:
    """Raise :class:`UserError` if two vehicles overlap, or may do so with the largest jitter."""
    vehicles = scene.base()

    # Two vehicles may both be shifted, towards each other: each counts as longer by twice the
    # shift.
    longer = torch.full_like(vehicles.x, 2.0 * scene.jitter_m)
    # The ego is never shifted.
    longer[:, 0] = 0.0
    longest = vehicles.with_(length=vehicles.length + longer)
    hits = pair_overlaps(longest, scene.road)[0].nonzero().tolist()

    # The first pair is named; users mend one after the other.
    if hits:
        one, other = hits[0]
        worst = f" (with jitter_m={scene.jitter_m:g} at its worst)" if scene.jitter_m else ""
        raise UserError(
            f"{scene.name}: {scene.label(one)} and {scene.label(other)} overlap{worst}; "
            "move one of them."
        )


def check_braking(scene: FixedScene, idm: IdmParameters) -> None:
    """Raise :class:`UserError` if a follower would have to brake harder than IDM can.

    Leaders are all vehicles ahead in a lane that the follower is in or moving to; they are taken to
    keep their speed. Jitter is taken at its worst.
    """
    # [1, i, j] below: i may have to brake for j.
    vehicles = scene.base()
    seen = perceive(vehicles, scene.road)

    # Leaders in the lane that a vehicle is in, and in the one it is moving to.
    shares = in_lane(seen, seen.attention.low) | in_lane(seen, seen.attention.high)
    ahead = shares & (vehicles.x[:, None, :] > vehicles.x[:, :, None])

    # Two shifted vehicles come closer by twice the jitter, a shifted one and the ego by once.
    slack = scene.jitter_m * (2.0 - vehicles.is_ego().double())
    gap = seen.pairs.ahead - torch.minimum(slack[:, None], slack[None, :])

    # Who stands remains standing.
    varied = (vehicles.speed > 0) * scene.jitter_mps
    fastest = vehicles.speed + varied
    slowest = (vehicles.speed - varied).clamp_min(0.0)
    # The fastest follower behind the slowest leader at the smallest gap.
    needed = needed_deceleration(fastest[:, :, None], slowest[:, None, :], gap)
    needed = torch.where(ahead, needed, 0.0)[0]

    # The hardest braking is named.
    if bool((needed > -idm.min_acceleration).any()):
        one, other = divmod(int(needed.argmax()), scene.vehicles)
        raise UserError(
            f"{scene.name}: {scene.label(one)} at {fastest[0, one]:g} m/s, "
            f"{float(gap[0, one, other]):.3g} m behind {scene.label(other)} at "
            f"{slowest[0, other]:g} m/s, would need {float(needed[one, other]):.3g} m/s2 to avoid "
            f"it, and env.idm.min_acceleration={idm.min_acceleration:g}; move them apart or slow "
            "it down."
        )


def check_drive(scene: FixedScene, idm: IdmParameters) -> None:
    """Raise :class:`UserError` if vehicles that follow and finish their lane changes collide."""
    hit = _first_overlap(scene, idm)
    if hit is None:
        return
    one, other, seconds = hit
    raise UserError(
        f"{scene.name}: {scene.label(one)} and {scene.label(other)} crash after "
        f"{seconds:.1f} s although all brake as IDM says; move them apart, slow the rear one "
        "down, or let a lane change be seen (signalled)."
    )


@lru_cache(maxsize=64)
def _first_overlap(scene: FixedScene, idm: IdmParameters) -> tuple[int, int, float] | None:
    """The first two vehicles that overlap and the time, s; None without an overlap."""
    # Episodes of the training stream; fewer of large scenes, for which every pair of vehicles is
    # looked at.
    most = max(1, MOST_VEHICLES**2 // scene.vehicles**2)
    # Without jitter all episodes are the same, and one drive tells.
    rows = min(DRIVES, most) if scene.jitter_m or scene.jitter_mps else 1
    episodes = torch.arange(rows)
    key = episode_key(Stream.TRAIN, torch.zeros_like(episodes), episodes)
    v = scene(key, torch.float64)

    # Everybody follows and steers to its target lane; nobody decides anything.
    steering = torch.zeros_like(v.x)
    centre = scene.road.centre_of(v.target_lane, v.y.dtype)
    steps = round(DRIVE_S / PHYSICS_STEP_S)
    for step in range(1, steps + 1):
        acceleration = following_acceleration(perceive(v, scene.road), idm)
        v, steering = drive(v, acceleration, steering, centre, PHYSICS_STEP_S)

        hits = pair_overlaps(v, scene.road)
        if bool(hits.any()):
            _, one, other = hits.nonzero()[0].tolist()
            return one, other, step * PHYSICS_STEP_S
    return None
