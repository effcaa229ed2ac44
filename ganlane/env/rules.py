"""What stays the same in an episode: how the ego drives, when it decides, and when an episode ends."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.parameters.driving import EgoParameters, IdmParameters
from ganlane.parameters.episode import EpisodeParameters
from ganlane.sim.road import Road
from ganlane.sim.steering import SteeringParameters


class Rules(NamedTuple):
    """What stays the same in an episode: the road, the ego's parameters, and when an episode ends."""

    road: Road
    ego: EgoParameters
    episode: EpisodeParameters
    idm: IdmParameters
    steering: SteeringParameters
    #: Physics steps [N] after which a recorded scene ends; None: never.
    scene_steps: Tensor | None = None


def scene_over(rules: Rules, step: Tensor) -> Tensor:
    """Whether the recorded scene has ended at physics step ``step``, bool [N]."""
    return torch.zeros_like(step, dtype=torch.bool) if rules.scene_steps is None else step >= rules.scene_steps
