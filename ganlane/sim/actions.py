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
    action: Tensor, speed: Tensor, desired: Tensor, actions: ActionParameters
) -> Tensor:
    """The speed that the ego aims at after ``action`` [N] of ``lane_speed``, m/s.

    ``speed`` [N] is the one before, ``desired`` [N] the highest, m/s.
    """
    step = constant(SPEED_STEPS, speed)[action] * actions.speed_step_mps
    # Who desires less than the lowest speed has one speed alone.
    lowest = desired.clamp_max(actions.lowest_speed_mps)
    return torch.minimum(torch.maximum(speed + step, lowest), desired)


def speed_changes(speed: Tensor, desired: Tensor, actions: ActionParameters) -> Tensor:
    """Whether ``faster`` and ``slower`` have an effect, bool [N, 2]; arguments as above."""
    return torch.stack((speed < desired, speed > actions.lowest_speed_mps), dim=1)


class Controls(NamedTuple):
    """Of an action of ``continuous``, each [N]: the effect on the lane, the line to steer to (m)
    and the acceleration until the next decision (m/s2).
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
    """Apply ``action`` [N, 2] of ``continuous`` to an ego whose current lane change has
    ``direction`` [N] int64.

    Numbers beyond -1 and 1 count as these. The acceleration is the one that reaches the desired
    speed within ``period_s``, if that is less.
    """
    # Columns [N, 1], as a road of every row has its numbers.
    ego = vehicles.columns(slice(EGO_INDEX, EGO_INDEX + 1))
    pedal, wheel = action.to(ego.y.dtype).clamp(-1.0, 1.0).split(1, dim=1)
    # The line, and the lane that it is in: where that is none, the ego's own.
    lane = road.lane_of(ego.y)
    line = (lane + wheel) * road.lane_width_m
    side = (wheel > 0.5).long() - (wheel < -0.5).long()
    side = torch.where(may_change(road, lane.long(), side, ego.x), side, 0)
    target = lane.long() + side
    shift = torch.sign(target - ego.target_lane)[:, 0]
    starts = shift != 0
    command = Command(
        target[:, 0], torch.where(starts, shift, direction), starts, torch.zeros_like(starts)
    )
    strongest = torch.where(pedal > 0, actions.strongest_acceleration, actions.strongest_braking)
    room = ((ego.desired_speed - ego.speed) / period_s).clamp_min(0.0)
    acceleration = torch.minimum(pedal * strongest, room)
    return Controls(command, line[:, 0], acceleration[:, 0])
