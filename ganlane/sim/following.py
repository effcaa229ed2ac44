"""Car following: the acceleration of every driver towards whoever is ahead in the lanes it attends to."""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.sim.idm import TABLE_V, IdmParameters, idm_acceleration
from ganlane.sim.neighbours import Neighbour, Scene, leader


def acceleration_behind(
    scene: Scene,
    ahead: Neighbour,
    parameters: IdmParameters = TABLE_V,
    headway_s: Tensor | float | None = None,
) -> Tensor:
    """IDM acceleration of each observer behind ``ahead``, m/s2, [N, K]."""
    own = scene.observers
    return idm_acceleration(own.speed, own.desired_speed, ahead.gap, ahead.speed, parameters, headway_s)


def following_acceleration(
    scene: Scene, parameters: IdmParameters = TABLE_V, headway_s: Tensor | float | None = None
) -> Tensor:
    """IDM acceleration of every observer, m/s2, [N, K].

    In the middle of a lane change a driver stands in two lanes, and the more demanding leader counts.
    """
    right = acceleration_behind(scene, leader(scene, scene.attention.low), parameters, headway_s)
    left = acceleration_behind(scene, leader(scene, scene.attention.high), parameters, headway_s)
    return torch.minimum(right, left)
