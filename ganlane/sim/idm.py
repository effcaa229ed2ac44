"""Car following by the Intelligent Driver Model (Treiber et al. 2000) with the paper's Table V."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from ganlane.parameters.driving import IdmParameters
from ganlane.sim.lanes import spanned
from ganlane.sim.neighbours import Neighbour, Scene, leader


class DriverIdm(NamedTuple):
    """Per-driver IDM parameters: tensors [N, M] instead of Table V's numbers."""

    min_gap_m: float
    headway_s: Tensor
    comfortable_deceleration: Tensor
    min_acceleration: Tensor
    max_acceleration: Tensor

    def per_lane(self) -> DriverIdm:
        """The parameters as [N, M, 1], to broadcast over lanes or pairs."""
        return DriverIdm(self.min_gap_m, *(value[..., None] for value in self[1:]))

    def of(self, rows: Tensor, columns: Tensor) -> DriverIdm:
        """The parameters of some drivers: indices [R], and [R, W] in these rows."""
        return DriverIdm(self.min_gap_m, *(value[rows].gather(1, columns) for value in self[1:]))

    def brake_scale(self) -> Tensor:
        """As :meth:`IdmParameters.brake_scale`."""
        return 2.0 * torch.sqrt(self.max_acceleration * self.comfortable_deceleration)


AnyIdm: TypeAlias = IdmParameters | DriverIdm
TABLE_V = IdmParameters()
#: Lower bound of the gap in the interaction term, m, which stays finite and gives the hardest braking.
SMALLEST_GAP_M = 0.1


def desired_gap(
    speed: Tensor,
    closing_speed: Tensor,
    parameters: AnyIdm = TABLE_V,
    headway_s: Tensor | float | None = None,
) -> Tensor:
    """Desired gap in metres at ``speed`` behind a leader that is approached at ``closing_speed`` (m/s).

    The dynamic part is never negative, so a faster leader does not reduce the desired gap below the minimum.
    """
    headway = parameters.headway_s if headway_s is None else headway_s
    dynamic = speed * headway + speed * closing_speed / parameters.brake_scale()
    return parameters.min_gap_m + dynamic.clamp_min(0.0)


def idm_acceleration(
    speed: Tensor,
    desired_speed: Tensor | float,
    gap: Tensor,
    leader_speed: Tensor,
    parameters: AnyIdm = TABLE_V,
    headway_s: Tensor | float | None = None,
) -> Tensor:
    """Acceleration in m/s2, within Table V's bounds; all tensors broadcast against each other.

    Args:
        speed: own speed, m/s, at least 0.
        desired_speed: own desired speed, m/s, above 0.
        gap: net gap to the leader (bumper to bumper), m; Table V's 10 000 m without a leader.
            A gap of 0 or less (an overlap) gives the hardest braking.
        leader_speed: m/s; without a leader it only enters the (negligible) approach term.
        parameters: common to all drivers, or per driver (:class:`DriverIdm`).
        headway_s: time headway per vehicle, s, instead of Table V's.
    """
    ratio = speed / desired_speed
    square = ratio * ratio
    wanted = desired_gap(speed, speed - leader_speed, parameters, headway_s)
    interaction = wanted / gap.clamp_min(SMALLEST_GAP_M)
    acceleration = parameters.max_acceleration * (1.0 - square * square - interaction * interaction)
    return acceleration.clamp(parameters.min_acceleration, parameters.max_acceleration)  # type: ignore[arg-type]


def equilibrium_gap(speed: Tensor, desired_speed: Tensor | float, parameters: IdmParameters = TABLE_V) -> Tensor:
    """Gap in metres at which the IDM acceleration behind a leader of equal ``speed`` is 0 (below desired speed)."""
    ratio = speed / desired_speed
    square = ratio * ratio
    return (parameters.min_gap_m + speed * parameters.headway_s) / torch.sqrt(1.0 - square * square)


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
