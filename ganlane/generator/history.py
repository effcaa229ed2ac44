"""What a driver's past looks like to the generator: projections of its last motions, moved on step by step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.generator.networks import Generator, Observation
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.vehicles import Vehicles


class History(NamedTuple):
    """Kept motions of [N, M] vehicles.

    Attributes:
        motions: observed - 1 tensors [N, M, 4H], input projections of the last motions, oldest first. They are not
            one tensor, since all of it would have to be copied to move on by a step.
        displacement: [N, M, 2], the displacement of the newest of them, m per 0.1 s.
    """

    motions: tuple[Tensor, ...]
    displacement: Tensor

    @property
    def projections(self) -> Tensor:
        """The motions as one tensor [N, M, observed - 1, 4H]."""
        return torch.stack(self.motions, dim=-2)


def displacement_of(vehicles: Vehicles) -> Tensor:
    """Displacement [N, M, 2] of the step that led here, m.

    Taken from speed and heading: differences of float32 positions lose 0.5 mm, or 0.05 m/s2, after 5 km.
    """
    length = vehicles.speed * PHYSICS_STEP_S
    return torch.stack([length * torch.cos(vehicles.heading), length * torch.sin(vehicles.heading)], dim=-1)


def start(generator: Generator, displacement: Tensor) -> History:
    """The past of a vehicle that has always moved by ``displacement`` [N, M, 2] a step."""
    one = generator.encoder.project(displacement, torch.zeros_like(displacement))
    # Copies, although they are alike: a compiled graph is made for inputs that are one tensor or several.
    return History(tuple(one.clone() for _ in range(generator.sizes.observed - 1)), displacement)


def recorded(generator: Generator, displacements: Tensor) -> History:
    """The past after the recorded ``displacements`` [N, M, observed - 1, 2]; its oldest motion stands twice."""
    motions = generator.project(displacements).unbind(dim=-2)
    return History((motions[0], *motions), displacements[..., -1, :])


def push(generator: Generator, history: History, displacement: Tensor) -> tuple[History, Tensor]:
    """The history with one more motion and without its oldest, and the motion's difference [N, M, 2].

    Only the new motion is embedded and projected.
    """
    difference = displacement - history.displacement
    new = generator.encoder.project(displacement, difference)
    return History((*history.motions[1:], new), displacement), difference


def observe(history: History, difference: Tensor, vehicles: Vehicles, extra: Tensor | None = None) -> Observation:
    """What the generator sees after :func:`push`."""
    if extra is None:
        extra = difference[..., :0]
    position = torch.stack([vehicles.x, vehicles.y], dim=-1)
    return Observation(history.motions, history.displacement, difference, position, vehicles.valid, extra)


def moved_by(vehicles: Vehicles, velocity_x: Tensor, velocity_y: Tensor) -> Vehicles:
    """The vehicles 0.1 s later at a new velocity (m/s, [N, M]): nobody rolls back or slides sideways.

    The lateral velocity is cut at :data:`STEEPEST` times the one along the road, so a standing car stands.
    """
    forward = velocity_x.clamp_min(0.0)
    limit = STEEPEST * forward
    aside = torch.maximum(torch.minimum(velocity_y, limit), -limit)
    speed = torch.sqrt(forward * forward + aside * aside + _TINY * _TINY)
    return vehicles.with_(
        x=vehicles.x + forward * PHYSICS_STEP_S,
        y=vehicles.y + aside * PHYSICS_STEP_S,
        speed=speed,
        heading=torch.atan(aside / forward.clamp_min(_SLOWEST_MPS)),
        acceleration=(speed - vehicles.speed) / PHYSICS_STEP_S,
    )


#: Tangent of the largest heading.
STEEPEST = 0.3
_SLOWEST_MPS = 1e-3
#: Keeps the gradient of a speed of 0 finite, m/s.
_TINY = 1e-6
