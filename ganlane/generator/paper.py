"""The paper's preset in closed loop: positions only, the first predicted displacement moves the vehicle."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.generator.history import History, displacement_of, moved_by, observe, push
from ganlane.generator.networks import Generator
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.vehicles import Vehicles


class Plan(NamedTuple):
    """Displacements still to be driven: ``ahead`` [N, M, execute_k, 2] in m, the next one first; ``left`` of them."""

    ahead: Tensor
    left: Tensor


def paper_step(
    generator: Generator, vehicles: Vehicles, history: History, noise: Tensor, plan: Plan | None = None
) -> tuple[Vehicles, History, Plan | None]:
    """All vehicles 0.1 s later, their history, and what is left of the plan.

    Without a plan (``execute_k`` = 1) one decoder step is run and driven. With one, ``execute_k`` steps are run
    and taken up by the vehicles that have driven their last plan to its end (each at its own time).
    """
    history, difference = push(generator, history, displacement_of(vehicles))
    seen = observe(history, difference, vehicles)
    steps = 1 if plan is None else plan.ahead.shape[-2]
    predicted = generator(seen, noise, steps)
    if plan is not None:
        spent = plan.left <= 0
        predicted = torch.where(spent[..., None, None], predicted, plan.ahead)
        plan = Plan(torch.roll(predicted, -1, dims=-2), torch.where(spent, steps, plan.left) - 1)
    velocity = predicted[..., 0, :] / PHYSICS_STEP_S
    return moved_by(vehicles, velocity[..., 0], velocity[..., 1]), history, plan
