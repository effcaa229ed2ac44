"""Whole recorded scenes driven on by a model: everybody jointly, step by step."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ganlane.generator.anchored import ANCHOR, AnchorParameters, DriverMemory, anchored_step
from ganlane.generator.history import recorded
from ganlane.generator.networks import Generator
from ganlane.generator.noise import wander
from ganlane.generator.stretches import RolloutScenes
from ganlane.generator.windows import OBSERVED_POSITIONS, PRESENT
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.lanes import ENTRY_M, Visibility
from ganlane.sim.vehicles import Vehicles


def recorded_vehicles(scenes: RolloutScenes, frame: int, desired_speed: Tensor) -> Vehicles:
    """The recorded vehicles [B, V] at ``frame`` (1 or later), their velocity the last displacement's.

    Each counts in the lane of its centre alone: recorded lanes are narrow and straightened to some decimetres,
    so by their bodies (here as good as without width) one in ten would stand in two lanes and be braked for.
    """
    position = scenes.positions[:, frame]
    velocity = (position - scenes.positions[:, frame - 1]) / PHYSICS_STEP_S
    speed = torch.sqrt((velocity * velocity).sum(-1))
    x, y = position.unbind(-1)
    target = scenes.target_lane[:, frame]
    return Vehicles(
        x=x,
        y=y,
        heading=torch.atan(velocity[..., 1] / velocity[..., 0].clamp_min(0.1)),
        speed=speed,
        acceleration=torch.zeros_like(x),
        length=scenes.length,
        width=torch.full_like(x, 2.0 * ENTRY_M),
        desired_speed=desired_speed,
        target_lane=target,
        visibility=torch.full_like(target, int(Visibility.CENTRE)),
        valid=scenes.present[:, frame],
    )


#: One step: the vehicles 0.1 s later, given them now and the number of the step.
Move = Callable[[Vehicles, int], Vehicles]


def drive(scenes: RolloutScenes, desired_speed: Tensor, move: Move) -> Tensor:
    """Positions [B, H, V, 2] in m when ``move`` drives everybody jointly for H steps after the observed frames.

    Vehicles that come later start when they appear, at their first recorded place and with the velocity of their
    first displacement, and are driven from there on. One whose recording ends vanishes at that frame.
    """
    vehicles, course = recorded_vehicles(scenes, PRESENT, desired_speed), []
    appeared = scenes.present.cumsum(dim=1) > 0
    for step in range(scenes.positions.shape[1] - OBSERVED_POSITIONS):
        moved = move(vehicles, step)
        entering = recorded_vehicles(scenes, PRESENT + step + 1, desired_speed)
        vehicles = moved.where(appeared[:, PRESENT + step], entering).with_(
            valid=entering.valid, target_lane=entering.target_lane
        )
        course.append(torch.stack([vehicles.x, vehicles.y], dim=-1))
    return torch.stack(course, dim=1)


def rollout(
    generator: Generator,
    scenes: RolloutScenes,
    headway: Tensor,
    desired_speed: Tensor,
    noise: Tensor,
    fresh: Tensor | None = None,
    noise_period_s: float = 5.0,
    parameters: AnchorParameters = ANCHOR,
) -> Tensor:
    """Positions [B, H, V, 2] in m when the model drives everybody jointly (:func:`drive`).

    Args:
        generator: of the calibrated preset.
        scenes: what was recorded; its number of frames gives H.
        headway, desired_speed: traits [B, V], s and m/s.
        noise: latent vectors [B, V, Z] at the start.
        fresh: [H, B, V, Z] standard normal numbers by which they wander; None keeps them.
        noise_period_s: how fast they wander.
    """
    past = scenes.positions[:, :OBSERVED_POSITIONS].diff(dim=1).transpose(1, 2)
    history = recorded(generator, past[..., :-1, :])
    memory, road = DriverMemory(history, torch.zeros_like(past[..., 0, :]), headway), scenes.road

    def move(vehicles: Vehicles, step: int) -> Vehicles:
        nonlocal memory, noise
        moved, memory = anchored_step(generator, vehicles, road, memory, noise, parameters)
        if fresh is not None:
            noise = wander(noise, fresh[step], noise_period_s)
        return moved

    return drive(scenes, desired_speed, move)
