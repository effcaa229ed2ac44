"""Joint rollouts of recorded scenes, and the per-driver parameters (headway and desired speed) that they use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ganlane.data import DrivingStatistics
from ganlane.generator.closed_loop import ANCHOR, AnchorParameters, DriverMemory, anchored_step, recorded, wander
from ganlane.generator.networks import Generator
from ganlane.generator.segments import OBSERVED_POSITIONS, PRESENT, Segments
from ganlane.keys import PHYSICS_STEP_S
from ganlane.parameters.generator import CalibratedConfig
from ganlane.sim.idm import TABLE_V
from ganlane.sim.neighbours import FREE_GAP_M, leader, perceive
from ganlane.sim.state import ENTRY_M, Road, Vehicles, Visibility

#: Levels of the headway quantiles.
QUANTILE_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
#: Quantiles of (gap - 2 m) / speed of recorded followers on US-101, s: the default where no statistics are given.
HEADWAY_QUANTILES_S = (0.50, 0.93, 1.27, 1.93, 3.27)
#: Lower bound of a recorded driver's headway, s.
SHORTEST_HEADWAY_S = 0.1
#: Desired speed above the present one, m/s: range drawn from in fitting, and the middle used in evaluation.
DESIRED_EXCESS_MPS = (1.0, 11.0)
#: Desired speed of all drivers if they do not differ: the middle of Table II's range, m/s.
COMMON_SPEED_MPS = 22.0
#: In fitting, standard deviation of the headways' logarithm about the balanced ones, so that drivers are off balance.
_SCATTER = 0.25


def recorded_vehicles(segments: Segments, frame: int, desired_speed: Tensor) -> Vehicles:
    """The recorded vehicles [B, V] at ``frame`` (1 or later), their velocity the last displacement's.

    Each occupies the lane of its centre only, with a small width: recorded lanes are narrow and straightened to some
    decimetres, so by its body one vehicle in ten would occupy two lanes and make others brake.
    """
    position = segments.positions[:, frame]
    velocity = (position - segments.positions[:, frame - 1]) / PHYSICS_STEP_S
    speed = torch.sqrt((velocity * velocity).sum(-1))
    x, y = position.unbind(-1)
    target = segments.target_lane[:, frame]
    return Vehicles(
        x=x,
        y=y,
        heading=torch.atan(velocity[..., 1] / velocity[..., 0].clamp_min(0.1)),
        speed=speed,
        acceleration=torch.zeros_like(x),
        length=segments.length,
        width=torch.full_like(x, 2.0 * ENTRY_M),
        desired_speed=desired_speed,
        target_lane=target,
        visibility=torch.full_like(target, int(Visibility.CENTRE)),
        valid=segments.present[:, frame],
    )


#: One step: from the vehicles now and the step's number to the vehicles 0.1 s later.
Move = Callable[[Vehicles, int], Vehicles]


def driven_positions(segments: Segments, desired_speed: Tensor, move: Move) -> Tensor:
    """Positions [B, H, V, 2] in m when ``move`` drives all vehicles jointly for H steps after the observed frames.

    A vehicle that appears later starts at its first recorded position with the velocity of its first displacement.
    A vehicle is removed at the frame where its recording ends.
    """
    vehicles, positions = recorded_vehicles(segments, PRESENT, desired_speed), []
    appeared = segments.present.cumsum(dim=1) > 0
    for step in range(segments.positions.shape[1] - OBSERVED_POSITIONS):
        moved = move(vehicles, step)
        entering = recorded_vehicles(segments, PRESENT + step + 1, desired_speed)
        vehicles = moved.where(appeared[:, PRESENT + step], entering).with_(
            valid=entering.valid, target_lane=entering.target_lane
        )
        positions.append(torch.stack([vehicles.x, vehicles.y], dim=-1))
    return torch.stack(positions, dim=1)


def rollout(
    generator: Generator,
    segments: Segments,
    headway: Tensor,
    desired_speed: Tensor,
    noise: Tensor,
    noise_period_s: float = 5.0,
    parameters: AnchorParameters = ANCHOR,
) -> Tensor:
    """Positions [K, B, H, V, 2] in m of K joint rollouts (:func:`driven_positions`) by the calibrated preset.

    Args:
        segments: their number of frames gives H.
        headway, desired_speed: of each driver, [B, V], s and m/s.
        noise: [1 + H, K, B, V, Z], latent vectors at the start, then the numbers that change them (:func:`wander`)
            with the time constant ``noise_period_s``.
    """
    samples = noise.shape[1]
    segments = segments.repeated(samples)
    headway, desired_speed = headway.repeat(samples, 1), desired_speed.repeat(samples, 1)
    latent, *fresh = noise.flatten(1, 2)
    past = segments.positions[:, :OBSERVED_POSITIONS].diff(dim=1).transpose(1, 2)
    history = recorded(generator, past[..., :-1, :])
    memory, road = DriverMemory(history, torch.zeros_like(past[..., 0, :]), headway), segments.road

    def move(vehicles: Vehicles, step: int) -> Vehicles:
        nonlocal memory, latent
        moved, memory = anchored_step(generator, vehicles, road, memory, latent, parameters)
        latent = wander(latent, fresh[step], noise_period_s)
        return moved

    return driven_positions(segments, desired_speed, move).unflatten(0, (samples, -1))


def headway_quantiles(statistics: Mapping[str, Any]) -> tuple[float, ...]:
    """The 5, 25, 50, 75 and 95 % headways in s from a checkpoint's ``driving_statistics``."""
    headway = DrivingStatistics.from_dict(statistics).headway
    return tuple(headway.quantile(level) for level in QUANTILE_LEVELS)


def headway_from_uniform(u: Tensor, quantiles_s: tuple[float, ...] = HEADWAY_QUANTILES_S) -> Tensor:
    """Headways in s from uniform numbers, by linear interpolation of the quantiles; flat beyond the outer ones."""
    values, levels = u.new_tensor(quantiles_s), u.new_tensor(QUANTILE_LEVELS)
    upper = torch.searchsorted(levels, u.contiguous()).clamp(1, len(QUANTILE_LEVELS) - 1)
    low, high = levels[upper - 1], levels[upper]
    part = ((u - low) / (high - low)).clamp(0.0, 1.0)
    return values[upper - 1] + part * (values[upper] - values[upper - 1])


def balanced_headway(vehicles: Vehicles, road: Road, otherwise: Tensor) -> Tensor:
    """The headway [N, M] in s at which IDM neither speeds up nor brakes now; ``otherwise`` where it is unknown.

    Uses gap, speed and desired speed. It is unknown for vehicles without a leader, or further behind it than the
    largest quantile.
    """
    ahead = leader(perceive(vehicles, road), vehicles.target_lane.to(vehicles.x.dtype))
    ratio = vehicles.speed / vehicles.desired_speed
    settled = ahead.gap * torch.sqrt((1.0 - ratio * ratio * ratio * ratio).clamp_min(0.0))
    headway = (settled - TABLE_V.min_gap_m) / vehicles.speed.clamp_min(1.0)
    known = (ahead.gap < FREE_GAP_M) & (headway <= HEADWAY_QUANTILES_S[-1])
    return torch.where(known, headway.clamp_min(SHORTEST_HEADWAY_S), otherwise)


def sampled_driver_params(segments: Segments, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Random headways and desired speeds for fitting, [B, V] each: about the balanced ones, above the present speeds.

    In congestion the recordings do not show the desired speeds.
    """
    u = torch.rand(2, *segments.length.shape, generator=random)
    scatter = torch.exp(_SCATTER * torch.randn(segments.length.shape, generator=random))
    low, high = DESIRED_EXCESS_MPS
    now = recorded_vehicles(segments, PRESENT, torch.ones_like(scatter))
    desired = now.speed + low + (high - low) * u[0]
    otherwise = headway_from_uniform(u[1])
    return balanced_headway(now.with_(desired_speed=desired), segments.road, otherwise) * scatter, desired


def common_driver_params(segments: Segments) -> tuple[Tensor, Tensor]:
    """The same for all drivers (an ablation), [B, V] each: Table V's headway and 22 m/s."""
    headway = torch.full_like(segments.length, TABLE_V.headway_s)
    return headway, torch.full_like(headway, COMMON_SPEED_MPS)


def typical_driver_params(segments: Segments) -> tuple[Tensor, Tensor]:
    """For evaluation, [B, V] each: the balanced headway or the median one, the middle desired speed."""
    now = recorded_vehicles(segments, PRESENT, torch.ones_like(segments.length))
    desired = now.speed + 0.5 * sum(DESIRED_EXCESS_MPS)
    median = torch.full_like(desired, HEADWAY_QUANTILES_S[len(HEADWAY_QUANTILES_S) // 2])
    return balanced_headway(now.with_(desired_speed=desired), segments.road, median), desired


def rollout_as_fitted(
    generator: Generator, segments: Segments, drivers: tuple[Tensor, Tensor], noise: Tensor, config: CalibratedConfig
) -> Tensor:
    """:func:`rollout` with a fit's settings; ``drivers`` are the headways and desired speeds."""
    anchor = replace(ANCHOR, washout_s=config.washout_s, further_inputs=config.further_inputs)
    return rollout(generator, segments, *drivers, noise, config.noise_period_s, anchor)


def evaluation_params(segments: Segments, config: CalibratedConfig) -> tuple[Tensor, Tensor]:
    """Headways and desired speeds for evaluation, [B, V] each."""
    return typical_driver_params(segments) if config.traits else common_driver_params(segments)
