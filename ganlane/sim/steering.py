"""Two-point visual control of steering (Salvucci and Gray 2004).

The driver looks at a near and a far point on the centre of the lane it wants to be in, and turns the wheel at

    d(delta)/dt = k_f d(theta_far)/dt + k_n d(theta_near)/dt + k_I theta_near .

Fixed gains from the literature are unstable at a step of 0.1 s and highway speeds. With gains inversely
proportional to speed a lane change takes about 4 s at every speed, without overshoot.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.sim.bicycle import WHEELBASE_M, slip_angle


@dataclass(frozen=True)
class SteeringParameters:
    """Look-ahead times (s), gains (each divided by speed, times the wheelbase) and limits."""

    near_s: float = 1.0
    far_s: float = 4.0
    gain_far: float = 1.5
    gain_near: float = 3.0
    gain_integral: float = 3.375
    #: Below this speed the law is one of distance travelled, not of time: a standing car does not turn its wheels.
    slow_mps: float = 3.0
    max_angle_rad: float = 0.5


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
