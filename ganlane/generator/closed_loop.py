"""One step of each preset in closed loop; the same functions run in fitting and in simulation.

**paper**: positions only, the first predicted displacement moves the vehicle (:func:`paper_step`).

**calibrated**: IDM and lane keeping are an anchor, the network's output is a residual on it
(:func:`anchored_step`)::

    acceleration         = IDM(own desired speed, own headway) + r - mean(r)
    lateral acceleration = 0.3 (target lane centre - y) - 1.1 v_y + q - mean(q)

with ``r = 4 tanh(. / 4)`` and ``q = 2 tanh(. / 2)`` in m/s2, and exponential means over 3 s (a washout); what would
move the body out of its lane is left out. The anchor keeps vehicles on the road, apart, and at their own speeds; the
network adds the variety and the reactions of recorded drivers.

Every vehicle carries a history of its motions (:class:`History`) and a latent vector that changes slowly
(:func:`wander`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.generator.networks import Generator, Observation
from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.generator import CalibratedConfig
from ganlane.sim.idm import IdmParameters, following_acceleration
from ganlane.sim.neighbours import Scene, leader, perceive
from ganlane.sim.state import Road, Vehicles

#: Tangent of the largest heading.
STEEPEST = 0.3
_SLOWEST_MPS = 1e-3
#: Keeps the gradient of a speed of 0 finite, m/s.
_TINY = 1e-6
#: The body keeps this distance from the lane's edge; outward residuals fade over the distance before it, m.
_MARGIN_M, _FADE_M = 0.1, 0.3


class History(NamedTuple):
    """Past motions of [N, M] vehicles.

    Attributes:
        motions: observed - 1 tensors [N, M, 4H], input projections of the last motions, oldest first. Separate
            tensors, because a single one would be copied whole at every step.
        displacement: [N, M, 2], the newest motion's displacement, m per 0.1 s.
    """

    motions: tuple[Tensor, ...]
    displacement: Tensor


def start(generator: Generator, displacement: Tensor) -> History:
    """The history of vehicles that have always moved by ``displacement`` [N, M, 2] per step."""
    one = generator.encoder.project(displacement, torch.zeros_like(displacement))
    # Equal, but separate tensors: a compiled graph assumes that inputs which share memory always do.
    return History(tuple(one.clone() for _ in range(generator.sizes.observed - 1)), displacement)


def recorded(generator: Generator, displacements: Tensor) -> History:
    """The history after recorded ``displacements`` [N, M, observed - 1, 2]; the oldest motion is repeated."""
    motions = generator.project(displacements).unbind(dim=-2)
    return History((motions[0], *motions), displacements[..., -1, :])


def push(generator: Generator, history: History, displacement: Tensor) -> tuple[History, Tensor]:
    """The history with the new motion, the only one projected, and its difference [N, M, 2] to the last one, m."""
    difference = displacement - history.displacement
    new = generator.encoder.project(displacement, difference)
    return History((*history.motions[1:], new), displacement), difference


def observe(history: History, difference: Tensor, vehicles: Vehicles, extra: Tensor) -> Observation:
    """The generator's input after :func:`push`."""
    position = torch.stack([vehicles.x, vehicles.y], dim=-1)
    return Observation(history.motions, history.displacement, difference, position, vehicles.valid, extra)


def displacement_of(vehicles: Vehicles) -> Tensor:
    """Displacement [N, M, 2] in the last step, m.

    Computed from speed and heading: differences of float32 positions lose 0.5 mm, or 0.05 m/s2, after 5 km.
    """
    length = vehicles.speed * PHYSICS_STEP_S
    return torch.stack([length * torch.cos(vehicles.heading), length * torch.sin(vehicles.heading)], dim=-1)


def moved_by(vehicles: Vehicles, velocity_x: Tensor, velocity_y: Tensor) -> Vehicles:
    """The vehicles 0.1 s later at a new velocity (m/s, [N, M]), without driving backwards or sliding sideways.

    The lateral velocity is limited to :data:`STEEPEST` times the longitudinal one, so a standing car stays in place.
    """
    forward = velocity_x.clamp_min(0.0)
    limit = STEEPEST * forward
    lateral = torch.maximum(torch.minimum(velocity_y, limit), -limit)
    speed = torch.sqrt(forward * forward + lateral * lateral + _TINY * _TINY)
    return vehicles.with_(
        x=vehicles.x + forward * PHYSICS_STEP_S,
        y=vehicles.y + lateral * PHYSICS_STEP_S,
        speed=speed,
        heading=torch.atan(lateral / forward.clamp_min(_SLOWEST_MPS)),
        acceleration=(speed - vehicles.speed) / PHYSICS_STEP_S,
    )


def wander(noise: Tensor, fresh: Tensor, period_s: float) -> Tensor:
    """``noise`` 0.1 s later: an Ornstein-Uhlenbeck process with unit variance and time constant ``period_s``.

    ``fresh`` are independent standard normal numbers of the same shape. A period of 0 draws anew at every step.
    """
    kept = math.exp(-PHYSICS_STEP_S / period_s) if period_s > 0 else 0.0
    return kept * noise + math.sqrt(1.0 - kept * kept) * fresh


class Plan(NamedTuple):
    """Predicted displacements not yet driven: ``ahead`` [N, M, execute_k, 2] in m, next first; ``left`` of them."""

    ahead: Tensor
    left: Tensor


def paper_step(
    generator: Generator, vehicles: Vehicles, history: History, noise: Tensor, plan: Plan | None = None
) -> tuple[Vehicles, History, Plan | None]:
    """One step of the paper's preset: vehicles 0.1 s later, their history, and the rest of the plan.

    Without a plan (``execute_k`` = 1) one decoder step is run and driven. With one, ``execute_k`` steps are run
    for the vehicles whose last plan is finished.
    """
    history, difference = push(generator, history, displacement_of(vehicles))
    steps = 1 if plan is None else plan.ahead.shape[-2]
    predicted = generator(observe(history, difference, vehicles, difference[..., :0]), noise, steps)
    if plan is not None:
        finished = plan.left <= 0
        predicted = torch.where(finished[..., None, None], predicted, plan.ahead)
        plan = Plan(torch.roll(predicted, -1, dims=-2), torch.where(finished, steps, plan.left) - 1)
    velocity = predicted[..., 0, :] / PHYSICS_STEP_S
    return moved_by(vehicles, velocity[..., 0], velocity[..., 1]), history, plan


@dataclass(frozen=True)
class AnchorParameters:
    """The anchor and the bounds of the residual; accelerations in m/s2.

    Attributes:
        idm: Table V; braking is limited to 8 m/s2, the grip of a dry road.
        lane_stiffness: pull to the target lane's centre, 1/s2.
        lane_damping: of the lateral velocity, 1/s; with the stiffness critically damped.
        residual: largest residual along and across the road.
        washout_s: time constant of the residual's mean, which is subtracted; infinite never does (an ablation).
        further_inputs: whether the network gets :func:`extra_inputs`; if not, they are 0 (an ablation).
    """

    idm: IdmParameters = field(default_factory=lambda: IdmParameters(min_acceleration=-8.0))
    lane_stiffness: float = 0.3
    lane_damping: float = 1.1
    residual: tuple[float, float] = (4.0, 2.0)
    washout_s: float = CalibratedConfig.washout_s
    further_inputs: bool = CalibratedConfig.further_inputs


ANCHOR = AnchorParameters()


class DriverMemory(NamedTuple):
    """State of the calibrated preset: history, the residual's mean [N, M, 2] in m/s2, and the headway [N, M] in s."""

    history: History
    mean: Tensor
    headway: Tensor


def extra_inputs(scene: Scene, anchor: Tensor, offset: Tensor) -> Tensor:
    """The further inputs [N, M, 4], each bounded and of order 1; without a leader the gap input is 1.

    ``anchor`` is IDM's acceleration, m/s2, ``offset`` the distance to the target lane's centre, m.
    """
    ahead = leader(scene, scene.vehicles.target_lane.to(anchor.dtype))
    gap = ahead.gap.clamp_min(0.0)
    closing = (scene.vehicles.speed - ahead.speed) / 5.0
    columns = [anchor.clamp(-4.0, 4.0), gap / (gap + 20.0), closing.clamp(-3.0, 3.0), (offset / 2.0).clamp(-3.0, 3.0)]
    return torch.stack(columns, dim=-1)


def inside_lane(residual: Tensor, offset: Tensor, velocity: Tensor, room: Tensor, damping: float) -> Tensor:
    """Lateral ``residual`` [N, M] in m/s2 without what would move the body out of its lane.

    Outward residuals fade to 0 over :data:`_FADE_M` before the point at which the vehicle, left alone, would come to
    rest ``room`` off the lane's centre: damping alone carries it another ``velocity / damping``. ``offset`` is the
    distance to the target lane's centre, m.
    """
    rest = velocity / damping - offset
    outwards = torch.where(residual > 0, rest, -rest)
    return residual * ((room - outwards) / _FADE_M).clamp(0.0, 1.0)


def anchored_step(
    generator: Generator,
    vehicles: Vehicles,
    road: Road,
    memory: DriverMemory,
    noise: Tensor,
    parameters: AnchorParameters = ANCHOR,
) -> tuple[Vehicles, DriverMemory]:
    """One step of the calibrated preset: vehicles 0.1 s later and their new memory.

    Args:
        vehicles: [N, M]; ``target_lane`` is the lane to keep or to change to, ``desired_speed`` is the driver's own.
        road: one per row in recorded scenes.
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
    observation = observe(history, difference, vehicles, extra if p.further_inputs else torch.zeros_like(extra))
    outputs = generator.decode(generator.summarise(observation), noise, observation, 1)[..., 0, :]
    limit = outputs.new_tensor(p.residual)
    residual = limit * torch.tanh(outputs / limit)
    mean = memory.mean + (PHYSICS_STEP_S / p.washout_s) * (residual - memory.mean)
    residual = residual - mean
    room = 0.5 * (road.lane_width_m - vehicles.width) - _MARGIN_M
    residual_y = inside_lane(residual[..., 1], offset, velocity[..., 1], room, p.lane_damping)
    velocity_x = velocity[..., 0] + (anchor_x + residual[..., 0]) * PHYSICS_STEP_S
    velocity_y = velocity[..., 1] + (anchor_y + residual_y) * PHYSICS_STEP_S
    return moved_by(vehicles, velocity_x, velocity_y), DriverMemory(history, mean, memory.headway)
