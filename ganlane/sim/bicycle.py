"""Kinematic bicycle model with slip angle (section IV.C), the centre of gravity in the middle."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

#: Distance between the axles, m.
WHEELBASE_M = 2.7


class Pose(NamedTuple):
    """Position x, y (m), heading (rad), speed (m/s) and realised acceleration (m/s2) of a vehicle."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor


def slip_angle(steering: Tensor) -> Tensor:
    """Angle between heading and motion at the centre, ``atan(l_r / (l_f + l_r) tan(delta))``, rad."""
    return torch.atan(0.5 * torch.tan(steering))


def advance(
    x: Tensor, y: Tensor, heading: Tensor, speed: Tensor, acceleration: Tensor, steering: Tensor, dt: float
) -> Pose:
    """One step of ``dt`` seconds.

    The distance is the mean of old and new speed times ``dt`` (exact for constant acceleration), so it never
    exceeds ``max(v_old, v_new) dt``; a vehicle that brakes to a stop does not roll back. The direction is the mean
    heading of the step, so a constant steering angle gives a circle, accurate to second order.
    """
    new_speed = (speed + acceleration * dt).clamp_min(0.0)
    distance = 0.5 * (speed + new_speed) * dt
    slip = slip_angle(steering)
    turn = distance / (0.5 * WHEELBASE_M) * torch.sin(slip)
    direction = heading + slip + 0.5 * turn
    return Pose(
        x + distance * torch.cos(direction),
        y + distance * torch.sin(direction),
        heading + turn,
        new_speed,
        (new_speed - speed) / dt,
    )
