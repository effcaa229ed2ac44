"""What the ego does on the commands of ``lane_speed`` and ``continuous``
(:class:`~ganlane.settings.actions.ActionParameters`); m, m/s, m/s2.

A lane change is commanded as in ``lane`` (:func:`ganlane.sim.dynamics.apply_action`), or follows
from the line that the ego steers to: it starts where the lane of that line becomes another one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.settings.actions import ActionParameters
from ganlane.sim.dynamics import Command
from ganlane.sim.lane_ends import may_change
from ganlane.sim.state import Road, Vehicles
from ganlane.torch_settings import constant

#: Steps of speed of each action: keep, left, right, faster, slower.
SPEED_STEPS = (0.0, 0.0, 0.0, 1.0, -1.0)


def commanded_speed(
    action: Tensor,
    speed: Tensor,
    desired: Tensor,
    actions: ActionParameters,
) -> Tensor:
    """The speed that the ego aims at after ``action`` of ``lane_speed``, m/s, [N].

    Args:
        action: numbers of the actions, [N] int64.
        speed: aimed at before, m/s, [N].
        desired: the highest, m/s, [N].
        actions: the step and the lowest speed.
    """
    step = constant(SPEED_STEPS, speed)[action] * actions.speed_step_mps
    # Who desires less than the lowest speed has one speed alone.
    lowest = desired.clamp_max(actions.lowest_speed_mps)
    return torch.minimum(torch.maximum(speed + step, lowest), desired)


def speed_changes(speed: Tensor, desired: Tensor, actions: ActionParameters) -> Tensor:
    """Whether ``faster`` and ``slower`` have an effect, bool [N, 2].

    Arguments as of :func:`commanded_speed`.
    """
    faster = speed < desired
    slower = speed > actions.lowest_speed_mps
    return torch.stack((faster, slower), dim=1)


class Controls(NamedTuple):
    """What an action of ``continuous`` commands, each [N].

    Attributes:
        command: its effect on the lane.
        line: lateral position to steer to, m.
        acceleration: until the next decision, m/s2.
    """

    command: Command
    line: Tensor
    acceleration: Tensor


def apply_controls(
    action: Tensor,
    vehicles: Vehicles,
    direction: Tensor,
    road: Road,
    actions: ActionParameters,
    period_s: float,
) -> Controls:
    """Apply ``action`` of ``continuous`` to the ego.

    Args:
        action: pedal (1 the strongest acceleration, -1 the strongest braking) and wheel (offset of
            the line from the centre of the lane, in lanes, to the left positive), [N, 2]. Numbers
            beyond -1 and 1 count as these.
        vehicles: [N, M].
        direction: of the ego's current lane change, [N] int64.
        road: the environment's.
        actions: the strongest acceleration and braking.
        period_s: between decisions, s: the ego accelerates no more than what reaches its desired
            speed within it.
    """
    # Columns [N, 1], as a road of every row has its numbers.
    ego = vehicles.columns(slice(EGO_INDEX, EGO_INDEX + 1))
    pedal, wheel = action.to(ego.y.dtype).clamp(-1.0, 1.0).split(1, dim=1)

    # The line, and the lane that it is in: where that is none, the ego's own.
    lane = road.lane_of(ego.y)
    line = (lane + wheel) * road.lane_width_m
    # Beyond half a lane's width the line is in the lane beside.
    side = (wheel > 0.5).long() - (wheel < -0.5).long()
    side = torch.where(may_change(road, lane.long(), side, ego.x), side, 0)
    target = lane.long() + side

    # A lane change starts where that is another lane than before.
    shift = torch.sign(target - ego.target_lane)[:, 0]
    starts = shift != 0
    direction = torch.where(starts, shift, direction)
    # The command alone does not leave the road: the body may, on its way (leaves_road).
    off_road = torch.zeros_like(starts)
    command = Command(target[:, 0], direction, starts, off_road)

    strongest = torch.where(pedal > 0, actions.strongest_acceleration, actions.strongest_braking)
    room = ((ego.desired_speed - ego.speed) / period_s).clamp_min(0.0)
    acceleration = torch.minimum(pedal * strongest, room)
    return Controls(command, line[:, 0], acceleration[:, 0])
