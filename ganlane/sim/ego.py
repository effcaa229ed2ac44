"""The ego's lane changes, motion and soft crashes; one ego (vehicle 0) per environment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX, LEFT, RIGHT
from ganlane.parameters.driving import EgoParameters, IdmParameters
from ganlane.sim.collisions import dangerously_close
from ganlane.sim.dynamics import SteeringParameters, advance, steer
from ganlane.sim.idm import acceleration_behind
from ganlane.sim.lanes import spanned
from ganlane.sim.neighbours import Neighbour, Scene, follower, leader, perceive
from ganlane.sim.state import Road, Vehicles


class Command(NamedTuple):
    """Effect of an action, each [N].

    Target lane; direction of the current lane change (-1 right, 0 none, +1 left); whether a change starts; whether
    the action would leave the road.
    """

    target_lane: Tensor
    direction: Tensor
    starts: Tensor
    off_road: Tensor


def apply_action(action: Tensor, target_lane: Tensor, direction: Tensor, lanes: int | Tensor, abort: bool) -> Command:
    """Apply ``action`` (0 keep, 1 left, 2 right) to an ego whose current lane change has ``direction``; [N] int64.

    During a lane change actions are ignored without penalty; with ``abort`` the opposite action turns back. An action
    that would leave the road has no effect except ``off_road``.
    """
    wish = torch.where(action == LEFT, 1, torch.where(action == RIGHT, -1, 0))
    accepted = (direction == 0) | (wish == -direction) if abort else direction == 0
    wish = torch.where(accepted, wish, 0)
    target = target_lane + wish
    off_road = (target < 0) | (target > lanes - 1)
    wish = torch.where(off_road, 0, wish)
    starts = wish != 0
    return Command(target_lane + wish, torch.where(starts, wish, direction), starts, off_road)


def ego_scene(vehicles: Vehicles, road: Road) -> Scene:
    """The :class:`Scene` with the ego as the only observer."""
    return perceive(vehicles, road, slice(EGO_INDEX, EGO_INDEX + 1))


def move_ego(
    vehicles: Vehicles, acceleration: Tensor, steering: Tensor, road: Road, wheel: SteeringParameters, dt: float
) -> tuple[Vehicles, Tensor]:
    """The ego after ``dt`` seconds (fields [N]) and its steering angle (rad, [N]).

    It accelerates with ``acceleration`` (m/s2, [N]) and steers towards its target lane.
    """
    ego = vehicles.at(EGO_INDEX)
    centre = road.centre_of(vehicles.target_lane[:, :1], ego.y.dtype)[:, 0]
    steering = steer(steering, ego.y, ego.heading, ego.speed, centre, dt, wheel)
    pose = advance(ego.x, ego.y, ego.heading, ego.speed, acceleration, steering, dt)
    return ego.with_(**pose._asdict()), steering


class Surroundings(NamedTuple):
    """The ego's IDM acceleration, m/s2, and whether it has a soft crash ahead or behind; each [N]."""

    acceleration: Tensor
    soft_crash: Tensor
    soft_crash_behind: Tensor


def ego_surroundings(scene: Scene, idm: IdmParameters, ego: EgoParameters) -> Surroundings:
    """IDM considers the leaders in all lanes that the ego attends to, soft crashes only the lanes that its body is
    in."""
    attention, body = spanned(scene.attention), spanned(scene.body)
    ahead, lanes = leader(scene, torch.cat((attention, body), dim=-1)), (attention.shape[-1], body.shape[-1])
    followed, near = map(Neighbour, *(number.split(lanes, dim=-1) for number in ahead))
    behind, speed = follower(scene, body), scene.observers.speed[..., None]
    closing = torch.where(behind.exists, behind.speed - speed, 0.0)
    limits = (ego.soft_crash_ttc_s, ego.soft_crash_gap_m)
    return Surroundings(
        acceleration_behind(scene, followed, idm).amin(-1)[:, 0],
        dangerously_close(near.gap, speed - near.speed, *limits).any(-1)[:, 0],
        dangerously_close(behind.gap, closing, *limits).any(-1)[:, 0],
    )


def change_progress(ego: Vehicles, direction: Tensor, road: Road) -> Tensor:
    """Progress of the current lane change, from 0 at its start to 1 at the target lane's centre; 0 without one;
    [N]."""
    width = road.lane_width_m if not isinstance(road.lane_width_m, Tensor) else road.lane_width_m[:, 0]
    remaining = (ego.y - ego.target_lane.to(ego.y.dtype) * width).abs() / width
    return torch.where(direction != 0, (1.0 - remaining).clamp(0.0, 1.0), 0.0)
