"""Motion of a vehicle: the kinematic bicycle model, and steering towards the centre of a lane.

The bicycle has a slip angle and its centre of gravity in the middle (section IV.C). Steering is two-point visual
control (Salvucci and Gray 2004): the driver looks at a near and a far point on the centre of the lane it wants to be
in, and turns the wheel at

    d(delta)/dt = k_f d(theta_far)/dt + k_n d(theta_near)/dt + k_I theta_near .

Fixed gains from the literature are unstable at a step of 0.1 s and highway speeds. With gains inversely
proportional to speed a lane change takes about 4 s at every speed, without overshoot.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.parameters.driving import SteeringParameters

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


STEERING = SteeringParameters()


def point_angle(offset: Tensor, distance: Tensor, heading: Tensor) -> Tensor:
    """Angle (rad) from the vehicle's axis to a point ``distance`` m ahead and ``offset`` m to the left."""
    return torch.atan(offset / distance) - heading


def point_angle_rate(offset: Tensor, distance: Tensor, lateral_speed: Tensor, yaw_rate: Tensor) -> Tensor:
    """Time derivative of :func:`point_angle`, rad/s, for a point that moves along with the vehicle."""
    slope = offset / distance
    return -lateral_speed / (distance * (1.0 + slope * slope)) - yaw_rate


def steer(
    steering: Tensor,
    y: Tensor,
    heading: Tensor,
    speed: Tensor,
    centre_y: Tensor,
    dt: float,
    parameters: SteeringParameters = STEERING,
) -> Tensor:
    """Steering angle (rad) after ``dt`` seconds of aiming at the lane centre ``centre_y`` (m); all [N] or [N, M]."""
    p = parameters
    pace = speed.clamp_min(p.slow_mps)
    gain = WHEELBASE_M / pace
    slip = slip_angle(steering)
    lateral_speed = speed * torch.sin(heading + slip)
    yaw_rate = speed / (0.5 * WHEELBASE_M) * torch.sin(slip)
    offset = centre_y - y
    near, far = pace * p.near_s, pace * p.far_s
    theta_near = point_angle(offset, near, heading)
    rate_near = point_angle_rate(offset, near, lateral_speed, yaw_rate)
    rate_far = point_angle_rate(offset, far, lateral_speed, yaw_rate)
    turn = p.gain_far * rate_far + p.gain_near * rate_near + p.gain_integral * theta_near * (speed / pace)
    return (steering + gain * turn * dt).clamp(-p.max_angle_rad, p.max_angle_rad)
