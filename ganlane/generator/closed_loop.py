"""Closed loop: one step of each preset, and rollouts of recorded scenes.

The same step drives in fitting and in simulation.

**paper**: positions only, the first predicted displacement moves the vehicle (:func:`paper_step`).

**calibrated**: IDM and lane keeping are an anchor, the network's output is a residual on it
(:func:`anchored_step`)::

    acceleration         = IDM(own desired speed, own headway) + r - mean(r)
    lateral acceleration = 0.3 (target lane centre - y) - 1.1 v_y + q - mean(q)

with ``r = 4 tanh(. / 4)`` and ``q = 2 tanh(. / 2)`` in m/s2, and exponential means over 3 s (a
washout); what would move the body out of its lane is left out. The anchor keeps vehicles on the
road, apart, and at their own speeds; the network adds the variety and the reactions of recorded
drivers.

Every vehicle carries a history of its motions (:class:`History`) and a latent vector that changes
slowly (:func:`wander`). Each driver has a headway and a desired speed of its own: in rollouts of
recorded scenes the headway at which IDM is in balance, where it is known
(:func:`balanced_headway`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.generator.networks import Generator, Observation
from ganlane.generator.windows import OBSERVED_POSITIONS, PRESENT, Segments
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.generated import (
    ANCHOR,
    HEADWAY_QUANTILES_S,
    QUANTILE_LEVELS,
    AnchorParameters,
)
from ganlane.settings.generator import CalibratedConfig
from ganlane.sim.idm import TABLE_V, following_acceleration, with_headways
from ganlane.sim.neighbours import FREE_GAP_M, Scene, leader, perceive
from ganlane.sim.state import ENTRY_M, Road, Vehicles, Visibility
from ganlane.torch_settings import constant

#: Tangent of the largest heading.
STEEPEST = 0.3
#: The body keeps this distance from the lane's edge, m.
_MARGIN_M = 0.1
#: Outward residuals fade over this distance before it, m.
_FADE_M = 0.3
#: Lower bound of a recorded driver's headway, s.
SHORTEST_HEADWAY_S = 0.1
#: Desired speed above the present one, m/s: range drawn from in fitting, and the middle used in
#: evaluation.
DESIRED_EXCESS_MPS = (1.0, 11.0)
#: In fitting, standard deviation of the headways' logarithm about the balanced ones, so that
#: drivers are off balance.
_SCATTER = 0.25


class History(NamedTuple):
    """Past motions of [N, M] vehicles.

    Attributes:
        motions: observed - 1 tensors [N, M, 4H], input projections of the last motions, oldest
            first; separate ones, because a single one would be copied whole at every step.
        displacement: the newest motion's, [N, M, 2], m per 0.1 s.
    """

    motions: tuple[Tensor, ...]
    displacement: Tensor


def start(generator: Generator, displacement: Tensor) -> History:
    """The history of vehicles that have always moved by ``displacement`` [N, M, 2] per step."""
    one = generator.encoder.project(displacement, torch.zeros_like(displacement))
    # Equal, but separate tensors: a compiled graph assumes that inputs which share memory always
    # do.
    motions = tuple(one.clone() for _ in range(generator.sizes.observed - 1))
    return History(motions, displacement)


def recorded(generator: Generator, displacements: Tensor) -> History:
    """The history after recorded ``displacements`` [N, M, observed - 1, 2].

    The oldest motion is repeated.
    """
    motions = generator.encoder.project_course(displacements)
    return History((motions[0], *motions), displacements[..., -1, :])


def push(generator: Generator, history: History, displacement: Tensor) -> tuple[History, Tensor]:
    """The history with the new motion, and its difference [N, M, 2] to the last one, m."""
    difference = displacement - history.displacement

    # Only the new motion is projected; those of the older ones are kept.
    new = generator.encoder.project(displacement, difference)
    motions = (*history.motions[1:], new)
    return History(motions, displacement), difference


def observe(
    history: History,
    difference: Tensor,
    vehicles: Vehicles,
    extra: Tensor,
) -> Observation:
    """The generator's input after :func:`push`.

    Args:
        history: with the newest motion.
        difference: of this motion to the one before, [N, M, 2], m.
        vehicles: now, [N, M].
        extra: further inputs, [N, M, extra_inputs].
    """
    return Observation(
        projections=history.motions,
        displacement=history.displacement,
        difference=difference,
        position=torch.stack([vehicles.x, vehicles.y], dim=-1),
        valid=vehicles.valid,
        extra=extra,
    )


def displacement_of(vehicles: Vehicles) -> Tensor:
    """Displacement [N, M, 2] in the last step, m.

    Computed from speed and heading: differences of float32 positions lose 0.5 mm, or 0.05 m/s2,
    after 5 km.
    """
    length = vehicles.speed * PHYSICS_STEP_S
    along = length * torch.cos(vehicles.heading)
    across = length * torch.sin(vehicles.heading)
    return torch.stack([along, across], dim=-1)


def moved_by(vehicles: Vehicles, velocity_x: Tensor, velocity_y: Tensor) -> Vehicles:
    """The vehicles 0.1 s later at a new velocity.

    Nobody drives backwards or slides sideways: the lateral velocity is limited to :data:`STEEPEST`
    times the longitudinal one, so a standing car stays in place.

    Args:
        vehicles: now, [N, M].
        velocity_x: along the road, m/s, [N, M].
        velocity_y: across the road, m/s, [N, M].
    """
    forward = velocity_x.clamp_min(0.0)
    limit = STEEPEST * forward
    lateral = torch.minimum(velocity_y, limit)
    lateral = torch.maximum(lateral, -limit)

    # The small terms keep the gradient at a speed of 0 finite.
    speed = torch.sqrt(forward * forward + lateral * lateral + 1e-6 * 1e-6)
    tangent = lateral / forward.clamp_min(1e-3)
    return vehicles.with_(
        x=vehicles.x + forward * PHYSICS_STEP_S,
        y=vehicles.y + lateral * PHYSICS_STEP_S,
        speed=speed,
        heading=torch.atan(tangent),
        acceleration=(speed - vehicles.speed) / PHYSICS_STEP_S,
    )


def wander(noise: Tensor, fresh: Tensor, period_s: float) -> Tensor:
    """The latent vectors 0.1 s later, of unit variance.

    Args:
        noise: the vectors now.
        fresh: independent standard normal numbers of the same shape.
        period_s: time constant, s; 0 draws anew at every step.
    """
    # An Ornstein-Uhlenbeck process, solved exactly: what stays, and what makes up the variance.
    share = 0.0
    if period_s > 0:
        share = math.exp(-PHYSICS_STEP_S / period_s)
    return share * noise + math.sqrt(1.0 - share * share) * fresh


def paper_step(
    generator: Generator,
    vehicles: Vehicles,
    history: History,
    noise: Tensor,
) -> tuple[Vehicles, History]:
    """One step of the paper's preset: vehicles 0.1 s later, and their history.

    One decoder step is run and driven.

    Args:
        generator: of the paper's preset.
        vehicles: now, [N, M].
        history: their motions before the last one, which follows from speed and heading.
        noise: latent vectors [N, M, Z].
    """
    history, difference = push(generator, history, displacement_of(vehicles))
    # The paper's preset has positions only: further inputs of width 0.
    observation = observe(history, difference, vehicles, difference[..., :0])

    displacement = generator(observation, noise, steps=1)[..., 0, :]
    velocity_x, velocity_y = (displacement / PHYSICS_STEP_S).unbind(-1)
    return moved_by(vehicles, velocity_x, velocity_y), history


class DriverMemory(NamedTuple):
    """State of the calibrated preset.

    Attributes:
        history: past motions.
        mean: of the residual, exponential over the washout, [N, M, 2], m/s2.
        headway: the driver's own, [N, M], s.
    """

    history: History
    mean: Tensor
    headway: Tensor


def extra_inputs(scene: Scene, anchor: Tensor, offset: Tensor) -> Tensor:
    """The further inputs [N, M, 4], each bounded and of order 1.

    Args:
        scene: vehicles and their neighbours.
        anchor: IDM's acceleration, m/s2, [N, M].
        offset: distance to the target lane's centre, m, [N, M].
    """
    ahead = leader(scene, scene.vehicles.target_lane.to(anchor.dtype))
    # Without a leader, the gap is so large that its input is 1.
    gap = ahead.gap.clamp_min(0.0)
    closing = (scene.vehicles.speed - ahead.speed) / 5.0
    columns = [
        anchor.clamp(-4.0, 4.0),
        # Bounded however large the gap; one half at 20 m.
        gap / (gap + 20.0),
        closing.clamp(-3.0, 3.0),
        (offset / 2.0).clamp(-3.0, 3.0),
    ]
    return torch.stack(columns, dim=-1)


def inside_lane(
    residual: Tensor,
    offset: Tensor,
    velocity: Tensor,
    room: Tensor,
    damping: float,
) -> Tensor:
    """The lateral residual [N, M], m/s2, without what would move the body out of its lane.

    Outward residuals fade to 0 over :data:`_FADE_M` before the point at which the vehicle, left
    alone, would come to rest ``room`` off the lane's centre: damping alone carries it another
    ``velocity / damping``.

    Args:
        residual: the network's, across the road, m/s2, [N, M].
        offset: distance to the target lane's centre, m, [N, M].
        velocity: across the road, m/s, [N, M].
        room: between the body, in the centre, and the lane's edge, m, [N, M].
        damping: of the anchor, 1/s.
    """
    # Where it comes to rest, from the lane's centre; then the same in the residual's direction.
    rest = velocity / damping - offset
    outwards = torch.where(residual > 0, rest, -rest)
    share = ((room - outwards) / _FADE_M).clamp(0.0, 1.0)
    return residual * share


def anchored_step(
    generator: Generator,
    vehicles: Vehicles,
    road: Road,
    memory: DriverMemory,
    noise: Tensor,
    parameters: AnchorParameters = ANCHOR,
    bound: Callable[[Scene], Tensor] | None = None,
) -> tuple[Vehicles, DriverMemory]:
    """One step of the calibrated preset: vehicles [N, M] 0.1 s later and their new memory.

    Args:
        generator: of the calibrated preset.
        vehicles: now; their ``target_lane`` is the lane to keep or to change to, ``desired_speed``
            the driver's own.
        road: that they are on; one per row in recorded scenes.
        memory: of the drivers.
        noise: latent vectors [N, M, Z]; zeros give the mean driver.
        parameters: of the anchor.
        bound: the anchor accelerates with no more than this, [N, M], m/s2.
    """
    p = parameters
    displacement = displacement_of(vehicles)
    history, difference = push(generator, memory.history, displacement)
    velocity_x, velocity_y = (displacement / PHYSICS_STEP_S).unbind(-1)

    # The anchor along the road: IDM.
    scene = perceive(vehicles, road)
    anchor_x = following_acceleration(scene, with_headways(p.idm, memory.headway))
    if bound is not None:
        anchor_x = torch.minimum(anchor_x, bound(scene))

    # Across it: a spring and a damper to the target lane's centre.
    offset = road.centre_of(vehicles.target_lane, vehicles.y.dtype) - vehicles.y
    anchor_y = p.lane_stiffness * offset - p.lane_damping * velocity_y

    # The network's residual, in m/s2. The decoder's first output is enough: each step decides anew.
    extra = extra_inputs(scene, anchor_x, offset)
    if not p.further_inputs:
        extra = torch.zeros_like(extra)
    observation = observe(history, difference, vehicles, extra)
    context = generator.summarise(observation)
    outputs = generator.decode(context, noise, observation, steps=1)[..., 0, :]
    limit = constant(p.residual, outputs)
    residual = limit * torch.tanh(outputs / limit)

    # The washout: without its mean, the residual cannot hold a speed or an offset of its own.
    mean = memory.mean + (PHYSICS_STEP_S / p.washout_s) * (residual - memory.mean)
    residual_x, residual_y = (residual - mean).unbind(-1)
    room = 0.5 * (road.lane_width_m - vehicles.width) - _MARGIN_M
    residual_y = inside_lane(residual_y, offset, velocity_y, room, p.lane_damping)

    # 0.1 s of both accelerations.
    velocity_x = velocity_x + (anchor_x + residual_x) * PHYSICS_STEP_S
    velocity_y = velocity_y + (anchor_y + residual_y) * PHYSICS_STEP_S
    memory = DriverMemory(history, mean, memory.headway)
    return moved_by(vehicles, velocity_x, velocity_y), memory


def recorded_vehicles(segments: Segments, frame: int, desired_speed: Tensor) -> Vehicles:
    """The recorded vehicles [B, V].

    Their velocity is that of the last displacement. Each occupies the lane of its centre only, with
    a small width: recorded lanes are narrow and straightened to some decimetres, so by its body one
    vehicle in ten would occupy two lanes and make others brake.

    Args:
        segments: B segments of V vehicles.
        frame: 1 or later.
        desired_speed: of the drivers, m/s, [B, V].
    """
    position = segments.positions[:, frame]
    target = segments.target_lane[:, frame]
    x, y = position.unbind(-1)

    # Finite at a vehicle's first frame, too: before it, positions go on at constant velocity.
    velocity = (position - segments.positions[:, frame - 1]) / PHYSICS_STEP_S
    # The bound keeps the angle of a standing vehicle small, where positions are noise.
    tangent = velocity[..., 1] / velocity[..., 0].clamp_min(0.1)
    return Vehicles(
        x=x,
        y=y,
        heading=torch.atan(tangent),
        speed=torch.sqrt((velocity * velocity).sum(-1)),
        acceleration=torch.zeros_like(x),
        length=segments.length,
        width=torch.full_like(x, 2.0 * ENTRY_M),
        desired_speed=desired_speed,
        target_lane=target,
        visibility=torch.full_like(target, int(Visibility.CENTRE)),
        valid=segments.present[:, frame],
    )


def driven_positions(
    segments: Segments, desired_speed: Tensor, move: Callable[[Vehicles, int], Vehicles]
) -> Tensor:
    """Positions [B, H, V, 2] in m when all vehicles of the segments are driven jointly.

    A vehicle that appears later starts at its first recorded position with the velocity of its
    first displacement. A vehicle is removed at the frame where its recording ends.

    Args:
        segments: 9 observed frames and H more of V vehicles.
        desired_speed: of the drivers, m/s, [B, V].
        move: takes the vehicles now and the step's number, from 0 to H - 1, to the vehicles 0.1 s
            later.
    """
    vehicles = recorded_vehicles(segments, PRESENT, desired_speed)
    appeared = segments.present.cumsum(dim=1) > 0

    positions = []
    for step in range(segments.positions.shape[1] - OBSERVED_POSITIONS):
        frame = PRESENT + step
        moved = move(vehicles, step)

        # Who has not appeared yet goes on as recorded: at constant velocity, up to its first frame.
        entering = recorded_vehicles(segments, frame + 1, desired_speed)
        vehicles = moved.where(appeared[:, frame], entering)

        # Who is recorded, and in which lane it wants to be, follows the recording at every step.
        vehicles = vehicles.with_(valid=entering.valid, target_lane=entering.target_lane)
        positions.append(torch.stack([vehicles.x, vehicles.y], dim=-1))
    return torch.stack(positions, dim=1)


def noise_shape(generator: Generator, segments: Segments, samples: int) -> tuple[int, ...]:
    """Shape [1 + H, K, B, V, Z] of the numbers that :func:`rollout` takes for K ``samples``."""
    steps = 1 + segments.future.shape[1]
    return (steps, samples, *segments.length.shape, generator.sizes.noise)


def rollout(
    generator: Generator,
    segments: Segments,
    drivers: tuple[Tensor, Tensor],
    noise: Tensor,
    config: CalibratedConfig,
) -> Tensor:
    """Positions [K, B, H, V, 2] in m of K joint rollouts by the calibrated preset.

    See :func:`driven_positions`.

    Args:
        generator: of the calibrated preset.
        segments: B of them, of H steps and V vehicles.
        drivers: their headways, s, and desired speeds, m/s, [B, V] each.
        noise: [1 + H, K, B, V, Z], the latent vectors at the start, then the numbers that change
            them (:func:`wander`).
        config: how fast they change.
    """
    # The samples are further rows of the batch: N = K * B.
    samples = noise.shape[1]
    segments = segments.repeated(samples)
    road = segments.road
    headway, desired_speed = drivers
    headway = headway.repeat(samples, 1)
    desired_speed = desired_speed.repeat(samples, 1)
    latent, *fresh = noise.flatten(1, 2)

    # The first step pushes the last observed displacement, so the history ends one before it.
    past = segments.positions[:, :OBSERVED_POSITIONS].diff(dim=1).transpose(1, 2)
    history = recorded(generator, past[..., :-1, :])
    no_mean = torch.zeros_like(past[..., 0, :])
    memory = DriverMemory(history, no_mean, headway)

    def move(vehicles: Vehicles, step: int) -> Vehicles:
        nonlocal memory, latent
        moved, memory = anchored_step(generator, vehicles, road, memory, latent)
        latent = wander(latent, fresh[step], config.noise_period_s)
        return moved

    positions = driven_positions(segments, desired_speed, move)
    return positions.unflatten(0, (samples, -1))


def headway_from_uniform(u: Tensor, quantiles_s: tuple[float, ...] = HEADWAY_QUANTILES_S) -> Tensor:
    """Headways in s, linear between their quantiles, flat beyond the outer ones.

    Args:
        u: uniform numbers of any shape.
        quantiles_s: headways at the levels ``QUANTILE_LEVELS``, s.
    """
    values = constant(quantiles_s, u)
    levels = constant(QUANTILE_LEVELS, u)

    # The pair of quantiles around u; the outer pairs serve for what is beyond them.
    upper = torch.searchsorted(levels, u.contiguous()).clamp(1, len(QUANTILE_LEVELS) - 1)
    lower = upper - 1
    part = (u - levels[lower]) / (levels[upper] - levels[lower])
    return values[lower] + part.clamp(0.0, 1.0) * (values[upper] - values[lower])


def balanced_headway(vehicles: Vehicles, road: Road, otherwise: Tensor) -> Tensor:
    """The headway [N, M] in s at which IDM neither speeds up nor brakes now.

    It follows from gap, speed and desired speed. For vehicles without a leader, or further behind
    it than the largest quantile, it is unknown.

    Args:
        vehicles: now, [N, M].
        road: that they are on.
        otherwise: the headway where it is unknown, s, [N, M].
    """
    target_lane = vehicles.target_lane.to(vehicles.x.dtype)
    ahead = leader(perceive(vehicles, road), target_lane)

    # IDM's equation for an acceleration of 0 at the leader's speed, solved for the headway:
    # gap * sqrt(1 - (v / v0)^4) = s0 + v T. Products in place of a power, whose last bits may
    # differ between batch sizes.
    ratio = vehicles.speed / vehicles.desired_speed
    free_share = (1.0 - ratio * ratio * ratio * ratio).clamp_min(0.0)
    settled = ahead.gap * torch.sqrt(free_share)
    headway = (settled - TABLE_V.min_gap_m) / vehicles.speed.clamp_min(1.0)

    follows = (ahead.gap < FREE_GAP_M) & (headway <= HEADWAY_QUANTILES_S[-1])
    return torch.where(follows, headway.clamp_min(SHORTEST_HEADWAY_S), otherwise)


def driver_params(
    segments: Segments, random: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Headways in s and desired speeds in m/s of the drivers, [B, V] each.

    Args:
        segments: B of them, with the present of V vehicles.
        random: for fitting: draws them about the balanced headways and above the present speeds,
            since in congestion the recordings do not show the desired speeds. None, for evaluation:
            the balanced headway or the median one, and the middle desired speed.
    """
    low, high = DESIRED_EXCESS_MPS
    shape = segments.length.shape
    one = torch.ones_like(segments.length)
    # Desired speeds are not known yet: 1 m/s holds their place.
    now = recorded_vehicles(segments, PRESENT, one)

    if random is None:
        median_s = HEADWAY_QUANTILES_S[len(HEADWAY_QUANTILES_S) // 2]
        otherwise = one * median_s
        scatter = one
        desired = now.speed + 0.5 * (low + high)
    else:
        excess, level = torch.rand(2, *shape, generator=random)
        otherwise = headway_from_uniform(level)
        scatter = torch.exp(_SCATTER * torch.randn(shape, generator=random))
        desired = now.speed + low + (high - low) * excess

    now = now.with_(desired_speed=desired)
    headway = balanced_headway(now, segments.road, otherwise)
    return headway * scatter, desired
