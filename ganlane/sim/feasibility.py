"""Can an IDM follower avoid a leader that brakes at the limit?"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.driving import IdmParameters
from ganlane.sim.idm import SMALLEST_GAP_M, TABLE_V, idm_acceleration

#: Simulated time, s: enough for a stop from 60 m/s at 1 m/s2.
HORIZON_S = 60.0


def needed_deceleration(speed: Tensor, leader_speed: Tensor, gap: Tensor) -> Tensor:
    """Constant deceleration (m/s2, >= 0) to avoid a leader at constant speed; infinite for a gap of 0 or less.

    Args:
        speed, leader_speed: m/s.
        gap: bumper to bumper, m.
    """
    closing = (speed - leader_speed).clamp_min(0.0)
    needed = closing * closing / (2.0 * gap.clamp_min(1e-9))
    return torch.where((gap <= 0) & (closing > 0), torch.inf, needed)


def smallest_gap(
    gap: Tensor, speed: Tensor, leader_speed: Tensor, desired_speed: float, idm: IdmParameters = TABLE_V
) -> Tensor:
    """Smallest gap (m) to a leader that brakes at ``idm.min_acceleration`` to a stop from now on; negative: a crash.

    Two vehicles, IDM, steps of 0.1 s. This leader is the worst of all that brake no harder than
    ``idm.min_acceleration``: any other is always ahead of it and no slower. So a driver that avoids this one also
    avoids crashes in a queue, where each leader may have to brake for its own.

    Args:
        gap, speed, leader_speed: at the start; m and m/s, broadcast.
        desired_speed: of the follower, m/s.
    """
    gap, speed, leader = torch.broadcast_tensors(gap.double(), speed.double(), leader_speed.double())
    smallest = gap
    for _ in range(round(HORIZON_S / PHYSICS_STEP_S)):
        acceleration = idm_acceleration(speed, desired_speed, gap, leader, idm)
        next_speed = (speed + acceleration * PHYSICS_STEP_S).clamp_min(0.0)
        next_leader = (leader + idm.min_acceleration * PHYSICS_STEP_S).clamp_min(0.0)
        gap = gap + 0.5 * PHYSICS_STEP_S * (leader + next_leader - speed - next_speed)
        speed, leader = next_speed, next_leader
        smallest = torch.minimum(smallest, gap)
    return smallest


def _survives(gap: Tensor, speed: Tensor, leader: float, desired_speed: float, idm: IdmParameters) -> Tensor:
    start = torch.tensor(leader, dtype=torch.float64)
    return smallest_gap(gap, speed, start, desired_speed, idm) >= gap.clamp(1e-9, SMALLEST_GAP_M)


@lru_cache(maxsize=1024)
def can_brake(
    gap_m: float, speed_mps: float, leader_speed_mps: float, desired_speed_mps: float, idm: IdmParameters = TABLE_V
) -> bool:
    """Whether a follower at ``speed_mps`` avoids the leader of :func:`smallest_gap`, with 0.1 m for rounding."""
    gap, speed = (torch.tensor([value], dtype=torch.float64) for value in (gap_m, speed_mps))
    return bool(_survives(gap, speed, leader_speed_mps, desired_speed_mps, idm)[0])


def least_gap(
    speed_mps: float, leader_speed_mps: float, desired_speed_mps: float, idm: IdmParameters = TABLE_V
) -> float:
    """Smallest gap (m, in steps of 0.1 m) for which :func:`can_brake` is true at this and every larger gap."""
    stopping_m = speed_mps * speed_mps / (-2.0 * idm.min_acceleration)
    gaps = torch.arange(1, int(10.0 * (1.2 * stopping_m + 10.0))).double() * 0.1
    speed = torch.full_like(gaps, speed_mps)
    crashes = ~_survives(gaps, speed, leader_speed_mps, desired_speed_mps, idm)
    return 0.1 * (1 + int(crashes.nonzero().max()) + 1) if bool(crashes.any()) else 0.1


def highest_speed(
    gap_m: float, leader_speed_mps: float, desired_speed_mps: float, idm: IdmParameters = TABLE_V
) -> float:
    """Highest speed (m/s, in steps of 0.1 m/s) for which :func:`can_brake` is true at this and every lower speed."""
    speeds = torch.arange(0, 1000).double() * 0.1
    crashes = ~_survives(torch.full_like(speeds, gap_m), speeds, leader_speed_mps, desired_speed_mps, idm)
    return 0.1 * max(0, int(crashes.nonzero().min()) - 1) if bool(crashes.any()) else float(speeds[-1])
