"""Checks of hand-made scenes: impossible numbers, overlaps, unavoidable crashes; errors name the vehicles."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.driving import IdmParameters
from ganlane.sim.bicycle import advance
from ganlane.sim.braking import needed_deceleration
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.following import following_acceleration
from ganlane.sim.neighbours import in_lane, perceive
from ganlane.sim.random import Stream, episode_key
from ganlane.sim.road import Road
from ganlane.sim.steering import steer
from ganlane.sim.vehicles import Vehicles

if TYPE_CHECKING:
    from ganlane.sim.fixed_scene import FixedScene, SceneVehicle

#: Duration of the test drive of :func:`check_drive`, s, and number of episodes with jitter that it simulates.
DRIVE_S = 15.0
DRIVES = 32


def check_rows(scene: FixedScene) -> None:
    """Raise :class:`UserError` for a scene of fewer than two vehicles, or a vehicle with an impossible number."""
    if len(scene.rows) < 2:
        raise UserError(f"{scene.name}: {len(scene.rows)} vehicles; a scene needs the ego and at least one other.")
    if not isinstance(scene.road.lanes, int) or isinstance(scene.road.lane_width_m, Tensor):
        raise UserError(f"{scene.name}: a scene set by hand needs one road for all episodes, not one per row.")
    if not all(0 <= jitter < torch.inf for jitter in (scene.jitter_m, scene.jitter_mps)):
        raise UserError(
            f"{scene.name}: jitter_m={scene.jitter_m:g}, jitter_mps={scene.jitter_mps:g}: expected at least 0."
        )
    for index, row in enumerate(scene.rows):
        fault = _fault(row, scene.road)
        if fault:
            raise UserError(f"{scene.name}: {scene.label(index)}: {fault}.")


def _fault(row: SceneVehicle, road: Road) -> str:
    """What is wrong with one vehicle; empty if nothing is."""
    given = {"x_m": row.x_m, "y_m": row.y_m, "speed_mps": row.speed_mps, "desired_speed_mps": row.desired_speed_mps}
    for name, value in (given | {"length_m": row.length_m, "width_m": row.width_m}).items():
        if value is not None and not -torch.inf < value < torch.inf:
            return f"{name}={value}: expected a finite number"
    if row.speed_mps < 0:
        return f"speed_mps={row.speed_mps:g}: expected at least 0; vehicles drive forwards only"
    for name in ("desired_speed_mps", "length_m", "width_m"):
        if getattr(row, name) <= 0:
            return f"{name}={getattr(row, name):g}: expected a number above 0"
    return _misplaced(row, road)


def _misplaced(row: SceneVehicle, road: Road) -> str:
    lanes = int(road.lanes)
    if row.lane is None and row.y_m is None:
        return "neither lane nor y_m is given; give one of them"
    for name, lane in (("lane", row.lane), ("target_lane", row.target_lane)):
        if lane is not None and not 0 <= lane < lanes:
            return f"{name}={lane}: expected 0 to {lanes - 1}, the road has {lanes} lanes"
    right, left, y = float(road.right_edge_m()), float(road.left_edge_m()), row.y_on(road)
    if y - 0.5 * row.width_m < right - 1e-6 or y + 0.5 * row.width_m > left + 1e-6:
        return f"y={y:g} m, width {row.width_m:g} m: expected on the road, which runs from {right:g} to {left:g} m"
    if row.lane is not None and row.lane != row.lane_on(road):
        return f"lane={row.lane} and y_m={y:g} contradict each other (that is lane {row.lane_on(road)}); give one"
    if row.target_lane is not None and abs(row.target_lane - row.lane_on(road)) > 1:
        return f"target_lane={row.target_lane}: expected a lane beside its own, {row.lane_on(road)}"
    return ""


def check_overlaps(scene: FixedScene) -> None:
    """Raise :class:`UserError` if two vehicles overlap, or may do so with the largest jitter."""
    vehicles = scene.base()
    longer = torch.full_like(vehicles.x, 2.0 * scene.jitter_m)
    longer[:, 0] = 0.0
    hits = pair_overlaps(vehicles.with_(length=vehicles.length + longer), scene.road)[0].nonzero().tolist()
    if hits:
        one, other = hits[0]
        worst = f" (with jitter_m={scene.jitter_m:g} at its worst)" if scene.jitter_m else ""
        raise UserError(
            f"{scene.name}: {scene.label(one)} and {scene.label(other)} overlap{worst}; move one of them."
        )


def check_braking(scene: FixedScene, idm: IdmParameters) -> None:
    """Raise :class:`UserError` if any follower would need to brake harder than ``idm.min_acceleration``.

    Leaders are all vehicles ahead in a lane that the follower is in or moving to; they are taken to keep their speed.
    Jitter is taken at its worst.
    """
    vehicles = scene.base()
    seen = perceive(vehicles, scene.road)
    shares = in_lane(seen, seen.attention.low) | in_lane(seen, seen.attention.high)
    ahead = shares & (vehicles.x[:, None, :] > vehicles.x[:, :, None])
    varied = (vehicles.speed > 0) * scene.jitter_mps
    slack = scene.jitter_m * (2.0 - (torch.arange(scene.vehicles) == 0).double())
    gap = seen.ahead - torch.minimum(slack[:, None], slack[None, :])
    fastest, slowest = vehicles.speed + varied, (vehicles.speed - varied).clamp_min(0.0)
    needed = torch.where(ahead, needed_deceleration(fastest[:, :, None], slowest[:, None, :], gap), 0.0)[0]
    if bool((needed > -idm.min_acceleration).any()):
        one, other = divmod(int(needed.argmax()), scene.vehicles)
        raise UserError(
            f"{scene.name}: {scene.label(one)} at {fastest[0, one]:g} m/s, {float(gap[0, one, other]):.3g} m behind "
            f"{scene.label(other)} at {slowest[0, other]:g} m/s, would need {float(needed[one, other]):.3g} m/s2 to "
            f"avoid it, and env.idm.min_acceleration={idm.min_acceleration:g}; move them apart or slow it down."
        )


def check_drive(scene: FixedScene, idm: IdmParameters) -> None:
    """Raise :class:`UserError` if vehicles that only follow and finish their lane changes collide."""
    hit = _first_overlap(scene, idm)
    if hit is not None:
        one, other, seconds = hit
        raise UserError(
            f"{scene.name}: {scene.label(one)} and {scene.label(other)} crash after {seconds:.1f} s although all "
            "brake as IDM says; move them apart, slow the rear one down, or let a lane change be seen (signalled)."
        )


@lru_cache(maxsize=64)
def _first_overlap(scene: FixedScene, idm: IdmParameters) -> tuple[int, int, float] | None:
    """The first two vehicles that overlap and the time, s; None without an overlap."""
    rows = DRIVES if scene.jitter_m or scene.jitter_mps else 1
    numbers = torch.arange(rows)
    vehicles = scene(episode_key(Stream.TRAIN, torch.zeros_like(numbers), numbers), torch.float64)
    steering = torch.zeros_like(vehicles.x)
    for step in range(1, round(DRIVE_S / PHYSICS_STEP_S) + 1):
        vehicles, steering = _follow(vehicles, steering, scene.road, idm)
        hits = pair_overlaps(vehicles, scene.road)
        if bool(hits.any()):
            _, one, other = hits.nonzero()[0].tolist()
            return one, other, step * PHYSICS_STEP_S
    return None


def _follow(vehicles: Vehicles, steering: Tensor, road: Road, idm: IdmParameters) -> tuple[Vehicles, Tensor]:
    """All vehicles after a physics step of IDM and steering, without new lane changes."""
    v = vehicles
    acceleration = following_acceleration(perceive(v, road), idm)
    centre = road.centre_of(v.target_lane, v.y.dtype)
    steering = steer(steering, v.y, v.heading, v.speed, centre, PHYSICS_STEP_S)
    pose = advance(v.x, v.y, v.heading, v.speed, acceleration, steering, PHYSICS_STEP_S)
    return v.with_(**pose._asdict()), steering
