"""The calibrated preset: a driver that follows IDM and its lane, plus what the network adds without lasting mean.

The network's output is a residual on an anchor::

    acceleration         = IDM(own desired speed, own headway) + r - mean(r)
    lateral acceleration = 0.3 (target lane centre - y) - 1.1 v_y + q - mean(q)

with ``r = 4 tanh(. / 4)`` and ``q = 2 tanh(. / 2)`` in m/s2, and exponential means over 3 s (a washout); what
would sway the body out of its lane is left out. The anchor keeps vehicles on the road, apart, and at their own
speeds; the network gives them the variety and the reactions of recorded drivers. The same
:func:`anchored_step` runs in fitting and in simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.generator.history import History, displacement_of, moved_by, observe, push
from ganlane.generator.networks import Generator
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.following import following_acceleration
from ganlane.sim.idm import IdmParameters
from ganlane.sim.neighbours import Scene, leader, perceive
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles

#: The body keeps this far from the lane's edge, and sways freely up to this much less, m.
_MARGIN_M, _FADE_M = 0.1, 0.3
#: Numbers per vehicle beside its motion: IDM's acceleration, gap, closing speed, offset to the target lane.
EXTRA_INPUTS = 4


@dataclass(frozen=True)
class AnchorParameters:
    """The anchor and the bounds of the residual; accelerations in m/s2.

    Attributes:
        idm: Table V; braking is cut at 8 m/s2, the grip of a dry road.
        lane_stiffness: pull to the target lane's centre, 1/s2.
        lane_damping: of the lateral velocity, 1/s; with the stiffness critically damped.
        residual: largest residual along and across the road.
        washout_s: time over which the residual's mean is taken away; infinite leaves it there (an ablation).
        further_inputs: whether the network sees :func:`extra_inputs`; without, they read as 0 (an ablation).
    """

    idm: IdmParameters = field(default_factory=lambda: IdmParameters(min_acceleration=-8.0))
    lane_stiffness: float = 0.3
    lane_damping: float = 1.1
    residual: tuple[float, float] = (4.0, 2.0)
    washout_s: float = 3.0
    further_inputs: bool = True


ANCHOR = AnchorParameters()


class DriverMemory(NamedTuple):
    """What is carried from step to step: the past, the residual's mean [N, M, 2], and the headway [N, M] in s."""

    history: History
    mean: Tensor
    headway: Tensor


def extra_inputs(scene: Scene, anchor: Tensor, offset: Tensor) -> Tensor:
    """The further inputs [N, M, 4], each about 1 in size and bounded: nobody ahead reads as a gap of 1.

    ``anchor`` is IDM's acceleration, m/s2, ``offset`` the way to the target lane's centre, m.
    """
    ahead = leader(scene, scene.vehicles.target_lane.to(anchor.dtype))
    gap = ahead.gap.clamp_min(0.0)
    closing = (scene.vehicles.speed - ahead.speed) / 5.0
    columns = [anchor.clamp(-4.0, 4.0), gap / (gap + 20.0), closing.clamp(-3.0, 3.0), (offset / 2.0).clamp(-3.0, 3.0)]
    return torch.stack(columns, dim=-1)


def washout(residual: Tensor, mean: Tensor, washout_s: float) -> tuple[Tensor, Tensor]:
    """``residual`` less its exponential mean, and the mean that includes it; a constant is removed in the end."""
    mean = mean + (PHYSICS_STEP_S / washout_s) * (residual - mean)
    return residual - mean, mean


def inside_lane(residual: Tensor, offset: Tensor, velocity: Tensor, room: Tensor, damping: float) -> Tensor:
    """Lateral ``residual`` [N, M] without what would carry the body out of its lane, m/s2.

    Drivers sway within their lane and stop short of its edge; what pushes outwards fades over the last
    :data:`_FADE_M` before the place where the vehicle comes to rest by itself is ``room`` off the centre.

    Args:
        offset: way to the target lane's centre, m.
        velocity: lateral, m/s; damped away it carries the vehicle another ``velocity / damping``.
        room: free space on each side of a vehicle in the middle of its lane, m.
    """
    rest = velocity / damping - offset
    outwards = torch.where(residual > 0, rest, -rest)
    return residual * ((room - outwards) / _FADE_M).clamp(0.0, 1.0)


def bounded(outputs: Tensor, largest: tuple[float, float]) -> Tensor:
    """Outputs [..., 2] softly limited to ``largest``, m/s2."""
    limit = outputs.new_tensor(largest)
    return limit * torch.tanh(outputs / limit)


def anchored_step(
    generator: Generator,
    vehicles: Vehicles,
    road: Road,
    memory: DriverMemory,
    noise: Tensor,
    parameters: AnchorParameters = ANCHOR,
) -> tuple[Vehicles, DriverMemory]:
    """All vehicles 0.1 s later, and the memory to keep.

    Args:
        generator: with ``extra_inputs`` = 4.
        vehicles: [N, M]; ``target_lane`` says where each keeps or goes, ``desired_speed`` is the driver's own.
        road: lanes; one per row in recorded scenes.
        memory: of the step before.
        noise: latent vectors [N, M, Z]; zeros give the mean driver.
    """
    p = parameters
    displacement = displacement_of(vehicles)
    history, difference = push(generator, memory.history, displacement)
    scene = perceive(vehicles, road)
    anchor_x = following_acceleration(scene, p.idm, memory.headway)
    offset = road.centre_of(vehicles.target_lane, vehicles.y.dtype) - vehicles.y
    velocity = displacement / PHYSICS_STEP_S
    anchor_y = p.lane_stiffness * offset - p.lane_damping * velocity[..., 1]
    extra = extra_inputs(scene, anchor_x, offset)
    seen = observe(history, difference, vehicles, extra if p.further_inputs else torch.zeros_like(extra))
    outputs = generator.decode(generator.summarise(seen), noise, seen, 1)[..., 0, :]
    residual, mean = washout(bounded(outputs, p.residual), memory.mean, p.washout_s)
    room = 0.5 * (road.lane_width_m - vehicles.width) - _MARGIN_M
    sway = inside_lane(residual[..., 1], offset, velocity[..., 1], room, p.lane_damping)
    velocity_x = velocity[..., 0] + (anchor_x + residual[..., 0]) * PHYSICS_STEP_S
    velocity_y = velocity[..., 1] + (anchor_y + sway) * PHYSICS_STEP_S
    return moved_by(vehicles, velocity_x, velocity_y), DriverMemory(history, mean, memory.headway)
