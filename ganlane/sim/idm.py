"""Car following by the Intelligent Driver Model (Treiber et al. 2000) with the paper's Table V.

And whom it can save: whether a follower avoids a leader that brakes at the limit.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.driving import IdmParameters
from ganlane.sim.lane_ends import stopping_room
from ganlane.sim.neighbours import Neighbour, Scene, leader
from ganlane.sim.state import spanned


class DriverIdm(NamedTuple):
    """IDM parameters of which some are tensors [N, M], one number per driver.

    Attributes:
        min_gap_m: gap at a standstill, m.
        headway_s: time headway, s.
        comfortable_deceleration: m/s2, above 0.
        min_acceleration, max_acceleration: bounds, m/s2; the first is the hardest braking, below 0.
    """

    min_gap_m: float
    headway_s: Tensor
    comfortable_deceleration: Tensor | float
    min_acceleration: Tensor | float
    max_acceleration: Tensor | float

    def per_lane(self) -> DriverIdm:
        """The parameters as [N, M, 1], to broadcast over lanes or pairs."""
        return DriverIdm._make(
            number[..., None] if isinstance(number, Tensor) else number for number in self
        )

    def of(self, rows: Tensor, columns: Tensor) -> DriverIdm:
        """The parameters of some drivers: indices [R], and [R, W] in these rows."""
        return DriverIdm._make(
            number[rows].gather(1, columns) if isinstance(number, Tensor) else number
            for number in self
        )

    def brake_scale(self) -> Tensor | float:
        """As :meth:`IdmParameters.brake_scale`."""
        product = self.max_acceleration * self.comfortable_deceleration
        root = product.sqrt() if isinstance(product, Tensor) else math.sqrt(product)
        return 2.0 * root


AnyIdm: TypeAlias = IdmParameters | DriverIdm


def with_headways(idm: IdmParameters, headway_s: Tensor) -> DriverIdm:
    """``idm`` with a time headway of each driver's own, s, [N, M]."""
    return DriverIdm(**{**vars(idm), "headway_s": headway_s})


TABLE_V = IdmParameters()
#: Lower bound of the gap in the interaction term, m, which stays finite and gives the hardest
#: braking.
SMALLEST_GAP_M = 0.1


def desired_gap(speed: Tensor, closing_speed: Tensor, parameters: AnyIdm = TABLE_V) -> Tensor:
    """Desired gap, m, at ``speed`` behind a leader approached at ``closing_speed``, m/s.

    IDM's ``s* = s0 + v T + v dv / (2 sqrt(a b))``. The dynamic part, all after ``s0``, is never
    negative, so a faster leader does not reduce the desired gap below the minimum.
    """
    approach = speed * closing_speed / parameters.brake_scale()
    dynamic = speed * parameters.headway_s + approach
    return parameters.min_gap_m + dynamic.clamp_min(0.0)


def idm_acceleration(
    speed: Tensor,
    desired_speed: Tensor | float,
    gap: Tensor,
    leader_speed: Tensor,
    parameters: AnyIdm = TABLE_V,
) -> Tensor:
    """Acceleration in m/s2, within Table V's bounds; all tensors broadcast against each other.

    Args:
        speed, desired_speed: own ones, m/s, at least 0 and above 0.
        gap: to the leader, bumper to bumper, m; Table V's 10 000 m without a leader. A gap of 0 or
            less (an overlap) gives the hardest braking.
        leader_speed: m/s; without a leader it only enters the (negligible) approach term.
        parameters: common to all drivers, or per driver (:class:`DriverIdm`).
    """
    # a (1 - (v / v0)^4 - (s* / s)^2); the exponent 4 of the free-road term without a power.
    ratio = speed / desired_speed
    square = ratio * ratio
    wanted = desired_gap(speed, speed - leader_speed, parameters)
    interaction = wanted / gap.clamp_min(SMALLEST_GAP_M)
    acceleration = parameters.max_acceleration * (1.0 - square * square - interaction * interaction)

    # Where they overlap the interaction term is huge: the bound makes it the hardest braking.
    return acceleration.clamp(parameters.min_acceleration, parameters.max_acceleration)  # type: ignore[arg-type]


def equilibrium_gap(
    speed: Tensor, desired_speed: Tensor | float, parameters: IdmParameters = TABLE_V
) -> Tensor:
    """Gap, m, at which IDM keeps ``speed`` behind a leader of the same (below desired speed)."""
    # Where the acceleration is 0: 1 - (v / v0)^4 = (s* / s)^2.
    ratio = speed / desired_speed
    square = ratio * ratio
    wanted = parameters.min_gap_m + speed * parameters.headway_s
    return wanted / torch.sqrt(1.0 - square * square)


def acceleration_behind(scene: Scene, ahead: Neighbour, parameters: AnyIdm) -> Tensor:
    """IDM acceleration of each observer behind ``ahead`` [N, K, L] in L lanes, m/s2."""
    # [N, K, 1], to broadcast over the L lanes.
    speed = scene.observers.speed[..., None]
    desired = scene.observers.desired_speed[..., None]
    return idm_acceleration(speed, desired, ahead.gap, ahead.speed, parameters.per_lane())


def following_acceleration(scene: Scene, parameters: AnyIdm = TABLE_V) -> Tensor:
    """IDM acceleration of every observer, m/s2, [N, K].

    During a lane change a vehicle is in two lanes, or three; the smallest acceleration over the
    lanes is used. The wall at the end of a lane is a standing obstacle.
    """
    lanes = spanned(scene.attention)
    return acceleration_in(scene, lanes, leader(scene, lanes), parameters)


def acceleration_in(scene: Scene, lanes: Tensor, ahead: Neighbour, parameters: AnyIdm) -> Tensor:
    """IDM acceleration of every observer, m/s2, [N, K], in all of its ``lanes`` [N, K, L]: behind
    ``ahead`` and before the lanes' walls.
    """
    acceleration = acceleration_behind(scene, ahead, parameters)
    if scene.road.has_lane_ends:
        keeps = lanes == scene.observers.target_lane[..., None]
        before = acceleration_before_wall(scene, lanes, keeps, parameters)
        acceleration = torch.minimum(acceleration, before)
    return acceleration.amin(-1)


def acceleration_before_wall(
    scene: Scene, lanes: Tensor, keeps: Tensor, parameters: AnyIdm
) -> Tensor:
    """IDM acceleration of each observer before the walls of ``lanes`` [N, K, L], m/s2.

    Infinite without a wall.

    Args:
        keeps: whether it keeps that lane, bool [N, K, L]
            (:func:`ganlane.sim.lane_ends.stopping_room`).
    """
    # A wall is as a leader that stands.
    room, has_wall = stopping_room(scene.observers, lanes, scene.road, keeps)
    standing = Neighbour(room, torch.zeros_like(room))
    acceleration = acceleration_behind(scene, standing, parameters)
    return torch.where(has_wall, acceleration, torch.inf)


# Can a follower avoid a leader that brakes at the limit?

#: Simulated time, s: enough for a stop from 60 m/s at 1 m/s2.
HORIZON_S = 60.0


def needed_deceleration(speed: Tensor, leader_speed: Tensor, gap: Tensor) -> Tensor:
    """Constant deceleration, m/s2, that avoids a leader of constant speed ``gap`` m ahead.

    Infinite at 0 m.
    """
    # Relative to the leader: v^2 / (2 b) is the way to a stop.
    closing = (speed - leader_speed).clamp_min(0.0)
    needed = closing * closing / (2.0 * gap.clamp_min(1e-9))
    return torch.where((gap <= 0) & (closing > 0), torch.inf, needed)


def _survives(
    gap_m: Tensor | float,
    speed_mps: Tensor | float,
    leader_speed_mps: float,
    desired_speed_mps: float,
    idm: IdmParameters,
) -> Tensor:
    """Whether followers at ``speed_mps`` avoid a leader that from now on brakes at the limit.

    The limit is ``idm.min_acceleration``. Two vehicles, IDM, steps of 0.1 s.

    This leader is the worst of all that brake no harder than ``idm.min_acceleration``: any other is
    always ahead of it and no slower. So a driver that avoids this one also avoids crashes in a
    queue, where each leader may have to brake for its own.

    Args:
        gap_m, speed_mps: of the followers at the start; one of them may be a tensor, or both.
        leader_speed_mps: of the leader at the start.
        desired_speed_mps: of the followers.

    Returns:
        Bool, of the shape of the tensors.
    """
    # In float64, since 600 steps add up and the result decides whether a scene is refused.
    start = (gap_m, speed_mps, leader_speed_mps)
    numbers = [torch.as_tensor(number, dtype=torch.float64) for number in start]
    gap, speed, leader_now = torch.broadcast_tensors(*numbers)
    first = gap
    smallest = gap

    # Trapezoids, as vehicles move in the simulation (dynamics.advance).
    for _ in range(round(HORIZON_S / PHYSICS_STEP_S)):
        acceleration = idm_acceleration(speed, desired_speed_mps, gap, leader_now, idm)
        next_speed = (speed + acceleration * PHYSICS_STEP_S).clamp_min(0.0)
        next_leader = (leader_now + idm.min_acceleration * PHYSICS_STEP_S).clamp_min(0.0)
        # Twice the mean speed of the leader less that of the follower.
        opening = leader_now + next_leader - speed - next_speed
        gap = gap + 0.5 * PHYSICS_STEP_S * opening
        speed = next_speed
        leader_now = next_leader
        smallest = torch.minimum(smallest, gap)

    # Where IDM's gap is cut off already at the start, it must only not shrink.
    return smallest >= first.clamp(1e-9, SMALLEST_GAP_M)


@lru_cache(maxsize=1024)
def can_brake(
    gap_m: float,
    speed_mps: float,
    leader_speed_mps: float,
    desired_speed_mps: float,
    idm: IdmParameters = TABLE_V,
) -> bool:
    """Whether a follower avoids a leader that brakes at the limit, with 0.1 m for rounding."""
    return bool(_survives(gap_m, speed_mps, leader_speed_mps, desired_speed_mps, idm))


def least_gap(
    speed_mps: float,
    leader_speed_mps: float,
    desired_speed_mps: float,
    idm: IdmParameters = TABLE_V,
) -> float:
    """Smallest gap, m, in steps of 0.1 m, from which on :func:`can_brake` is true."""
    # From full speed to a stop; a fifth and 10 m more is surely enough.
    stopping_m = speed_mps * speed_mps / (-2.0 * idm.min_acceleration)
    enough_m = 1.2 * stopping_m + 10.0
    gaps = torch.arange(1, int(10.0 * enough_m)).double() * 0.1
    crashes = ~_survives(gaps, speed_mps, leader_speed_mps, desired_speed_mps, idm)
    if not bool(crashes.any()):
        return 0.1
    # One step beyond the largest gap that is too small; entry 0 is a gap of one step.
    largest = 1 + int(crashes.nonzero().max())
    return 0.1 * (largest + 1)


def highest_speed(
    gap_m: float, leader_speed_mps: float, desired_speed_mps: float, idm: IdmParameters = TABLE_V
) -> float:
    """Highest speed, m/s, in steps of 0.1 m/s, up to which :func:`can_brake` is true."""
    # 0 to 99.9 m/s, all in one simulation.
    speeds = torch.arange(0, 1000).double() * 0.1
    crashes = ~_survives(gap_m, speeds, leader_speed_mps, desired_speed_mps, idm)
    if not bool(crashes.any()):
        return float(speeds[-1])
    # One step below the lowest speed that is too high.
    lowest = int(crashes.nonzero().min())
    return 0.1 * max(0, lowest - 1)
