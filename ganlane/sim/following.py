"""Car following: IDM acceleration of every driver behind the leaders in the lanes it attends to."""

from __future__ import annotations

from torch import Tensor

from ganlane.sim.idm import TABLE_V, AnyIdm, idm_acceleration
from ganlane.sim.lanes import spanned
from ganlane.sim.neighbours import Neighbour, Scene, leader


def acceleration_behind(
    scene: Scene,
    ahead: Neighbour,
    parameters: AnyIdm = TABLE_V,
    headway_s: Tensor | float | None = None,
) -> Tensor:
    """IDM acceleration of each observer behind ``ahead`` ([N, K], or [N, K, L] in L lanes), m/s2, of that shape."""
    own = scene.observers
    speed, desired = own.speed, own.desired_speed
    if ahead.gap.ndim == 3:
        speed, desired = speed[..., None], desired[..., None]
        headway_s = headway_s[..., None] if isinstance(headway_s, Tensor) else headway_s
        parameters = parameters.per_lane()
    return idm_acceleration(speed, desired, ahead.gap, ahead.speed, parameters, headway_s)


def following_acceleration(
    scene: Scene, parameters: AnyIdm = TABLE_V, headway_s: Tensor | float | None = None
) -> Tensor:
    """IDM acceleration of every observer, m/s2, [N, K].

    During a lane change a vehicle is in two lanes, or three; the smallest acceleration over the lanes is used.
    """
    ahead = leader(scene, spanned(scene.attention))
    return acceleration_behind(scene, ahead, parameters, headway_s).amin(-1)
