"""Motion of a vehicle, by the kinematic bicycle model and steering towards a lane's centre; and
what the ego does.

The bicycle has a slip angle and its centre of gravity in the middle (section IV.C). Steering is
two-point visual control (Salvucci and Gray 2004): the driver looks at a near and a far point on the
centre of the lane it wants to be in, and turns the wheel at

    d(delta)/dt = k_f d(theta_far)/dt + k_n d(theta_near)/dt + k_I theta_near .

Fixed gains from the literature are unstable at a step of 0.1 s and highway speeds. With gains
inversely proportional to speed a lane change takes about 4 s at every speed, without overshoot.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.settings.driving import EgoParameters, IdmParameters, SteeringParameters
from ganlane.sim.collisions import dangerously_close
from ganlane.sim.idm import acceleration_in
from ganlane.sim.lane_ends import may_change
from ganlane.sim.neighbours import Neighbour, Scene, follower, leader, perceive
from ganlane.sim.state import Road, Vehicles, spanned
from ganlane.torch_settings import constant

#: Distance between the axles, m.
WHEELBASE_M = 2.7
#: A heading, a steering angle (rad) and a lateral position (m) of at most this are 0.
REST = 1e-12
STEERING = SteeringParameters()


class Pose(NamedTuple):
    """Of a vehicle: x, y (m), heading (rad), speed (m/s) and realised acceleration (m/s2)."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor


def slip_angle(steering: Tensor) -> Tensor:
    """Angle from heading to motion at the centre, ``atan(l_r / (l_f + l_r) tan(delta))``, rad."""
    return torch.atan(0.5 * torch.tan(steering))


def at_rest(number: Tensor) -> Tensor:
    """``number``, and 0 where it is at most :data:`REST`.

    A driver that keeps its lane comes closer to its centre by a constant factor in every step, so
    after a minute its numbers are denormal, with which processors are slow: snapped to 0, the
    kernel's slowest stretch took 1.32 ms instead of 1.62 ms at 1024 rows. This is done in the model
    and not by a mode of the processor: kernel, tensor code on any device and scalar twin stay the
    same, and the caller's threads keep their mode.
    """
    return torch.nn.functional.hardshrink(number, REST)


def advance(
    x: Tensor,
    y: Tensor,
    heading: Tensor,
    speed: Tensor,
    acceleration: Tensor,
    steering: Tensor,
    dt: float,
) -> Pose:
    """One step of ``dt`` seconds.

    The distance is the mean of old and new speed times ``dt`` (exact for constant acceleration), so
    it never exceeds ``max(v_old, v_new) dt``; a vehicle that brakes to a stop does not roll back.
    The direction is the mean heading of the step, so a constant steering angle gives a circle,
    accurate to second order.
    """
    # A vehicle that stops within the step stays where it stopped: no speed is below 0.
    new_speed = (speed + acceleration * dt).clamp_min(0.0)
    distance = 0.5 * (speed + new_speed) * dt
    slip = slip_angle(steering)
    # Yaw rate of the bicycle about its centre, v sin(slip) / l_r, times the time.
    turn = distance / (0.5 * WHEELBASE_M) * torch.sin(slip)
    direction = heading + slip + 0.5 * turn
    return Pose(
        x + distance * torch.cos(direction),
        at_rest(y + distance * torch.sin(direction)),
        at_rest(heading + turn),
        new_speed,
        (new_speed - speed) / dt,
    )


def steer(
    steering: Tensor,
    y: Tensor,
    heading: Tensor,
    speed: Tensor,
    centre_y: Tensor,
    dt: float,
    parameters: SteeringParameters = STEERING,
) -> Tensor:
    """Steering angle (rad) after ``dt`` seconds of aiming at the lane centre ``centre_y`` (m).

    All [N] or [N, M].
    """

    def angle_rate(distance: Tensor) -> Tensor:
        """Of the angle to a point ``distance`` m ahead that moves with the vehicle, rad/s."""
        # Derivative of atan(offset / distance), of which the heading turns away.
        slope = offset / distance
        return -lateral_speed / (distance * (1.0 + slope * slope)) - yaw_rate

    p = parameters
    # At walking pace the gains, which grow as 1 / speed, would be too large.
    pace = speed.clamp_min(p.slow_mps)
    gain = WHEELBASE_M / pace
    slip = slip_angle(steering)
    lateral_speed = speed * torch.sin(heading + slip)
    yaw_rate = speed / (0.5 * WHEELBASE_M) * torch.sin(slip)
    offset = centre_y - y
    # Both points lie as many seconds ahead at every speed.
    near = pace * p.near_s
    far = pace * p.far_s
    theta_near = torch.atan(offset / near) - heading
    turn = p.gain_far * angle_rate(far) + p.gain_near * angle_rate(near)
    # The angle to the near point itself; it fades where the vehicle stands.
    turn = turn + p.gain_integral * theta_near * (speed / pace)
    return at_rest((steering + gain * turn * dt).clamp(-p.max_angle_rad, p.max_angle_rad))


def drive(
    vehicles: Vehicles,
    acceleration: Tensor,
    steering: Tensor,
    line: Tensor,
    dt: float,
    parameters: SteeringParameters = STEERING,
) -> tuple[Vehicles, Tensor]:
    """The vehicles ``dt`` seconds later, and their steering angles, rad.

    They accelerate with ``acceleration``, m/s2, and steer to the lines at ``line``, m. All [N] or
    [N, M].
    """
    # The kinematics know no lanes: a lane change is another line to steer to.
    pose = (vehicles.y, vehicles.heading, vehicles.speed)
    steering = steer(steering, *pose, line, dt, parameters)
    moved = advance(vehicles.x, *pose, acceleration, steering, dt)
    return vehicles.with_(**moved._asdict()), steering


# The ego: vehicle 0 of every environment


#: The side to which each action wishes to go: keep, left, right.
SIDES = (0, 1, -1)
#: The same with the actions that change the speed: faster, slower.
COMMANDED_SIDES = (*SIDES, 0, 0)


class Command(NamedTuple):
    """Effect of an action, each [N].

    Target lane; direction of the current lane change (-1 right, 0 none, +1 left); whether a change
    starts; whether the action would leave the road.
    """

    target_lane: Tensor
    direction: Tensor
    starts: Tensor
    off_road: Tensor


def is_heard(side: Tensor, direction: Tensor, abort: bool) -> Tensor:
    """Whether a wish to go to ``side`` is obeyed during a lane change in ``direction`` (each -1, 0
    or 1).

    During a lane change actions are ignored; with ``abort`` the opposite one turns back.
    """
    idle = direction == 0
    return idle | (side == -direction) if abort else idle


def stays_on_road(vehicles: Vehicles, side: Tensor, road: Road) -> Tensor:
    """Whether a change to each ``side`` [N, S] (-1, 0 or 1) leaves the ego on the road, [N, S].

    The lane is the one beside its target lane, where the ego is.
    """
    ego = slice(EGO_INDEX, EGO_INDEX + 1)
    return may_change(road, vehicles.target_lane[:, ego], side, vehicles.x[:, ego])


def apply_action(
    action: Tensor, vehicles: Vehicles, direction: Tensor, road: Road, abort: bool
) -> Command:
    """Apply ``action`` (0 keep, 1 left, 2 right; others keep the lane) to an ego whose current lane
    change has ``direction``; [N] int64.

    An action that is not heard has no effect and no penalty (:func:`is_heard`); one that would
    leave the road has no effect except ``off_road``.
    """
    side = constant(COMMANDED_SIDES, action)[action]
    # First what the ego ignores, then what the road does not have.
    side = torch.where(is_heard(side, direction, abort), side, 0)
    # The episode ends with this command; the target lane stays a lane of the road.
    off_road = ~stays_on_road(vehicles, side[:, None], road)[:, 0]
    side = torch.where(off_road, 0, side)
    starts = side != 0
    return Command(
        vehicles.target_lane[:, EGO_INDEX] + side,
        torch.where(starts, side, direction),
        starts,
        off_road,
    )


def ego_scene(vehicles: Vehicles, road: Road) -> Scene:
    """The :class:`Scene` with the ego as the only observer."""
    return perceive(vehicles, road, slice(EGO_INDEX, EGO_INDEX + 1))


def ego_surroundings(
    scene: Scene, idm: IdmParameters, ego: EgoParameters
) -> tuple[Tensor, Tensor, Tensor]:
    """The ego's IDM acceleration, m/s2, and whether it has a soft crash ahead, and behind; each
    [N].

    The ego is the only observer of ``scene``. IDM considers the leaders in all lanes that it
    attends to, soft crashes only the lanes that its body is in.
    """
    # The driver brakes for who is in a lane it is going to; a soft crash needs its body there.
    attention = spanned(scene.attention)
    body = spanned(scene.body)

    # One search for both kinds of lanes.
    gap, speed = leader(scene, torch.cat((attention, body), dim=-1))
    attended = attention.shape[-1]
    followed = Neighbour(gap[..., :attended], speed[..., :attended])
    near = Neighbour(gap[..., attended:], speed[..., attended:])
    behind = follower(scene, body)

    speed = scene.observers.speed[..., None]
    # Who is behind closes in if it is the faster one.
    closing = torch.where(behind.exists, behind.speed - speed, 0.0)
    limits = (ego.soft_crash_ttc_s, ego.soft_crash_gap_m)

    acceleration = acceleration_in(scene, attention, followed, idm)[:, 0]
    close_ahead = dangerously_close(near.gap, speed - near.speed, *limits).any(-1)[:, 0]
    close_behind = dangerously_close(behind.gap, closing, *limits).any(-1)[:, 0]
    return acceleration, close_ahead, close_behind


def change_progress(ego: Vehicles, direction: Tensor, road: Road) -> Tensor:
    """Progress [N] of the current lane change, 0 at its start to 1 at the target lane's centre.

    0 without one.
    """
    width = road.lane_width_m
    if isinstance(width, Tensor):
        width = width[:, 0]
    # In lane widths: 1 at the start of a change by one lane, 0 at its end.
    target_y = ego.target_lane.to(ego.y.dtype) * width
    remaining = (ego.y - target_y).abs() / width
    return torch.where(direction != 0, (1.0 - remaining).clamp(0.0, 1.0), 0.0)
