"""Intelligent Driver Model (Treiber et al. 2000) with the paper's Table V."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from ganlane.parameters.driving import IdmParameters


class DriverIdm(NamedTuple):
    """IDM with parameters of its own for every driver: tensors [N, M] in the place of Table V's numbers."""

    min_gap_m: float
    headway_s: Tensor
    comfortable_deceleration: Tensor
    min_acceleration: Tensor
    max_acceleration: Tensor

    def per_lane(self) -> DriverIdm:
        """Each driver's for several lanes, or for pairs with all others: [N, M, 1]."""
        return DriverIdm(self.min_gap_m, *(value[..., None] for value in self[1:]))

    def brake_scale(self) -> Tensor:
        """As :meth:`IdmParameters.brake_scale`."""
        return 2.0 * torch.sqrt(self.max_acceleration * self.comfortable_deceleration)


AnyIdm: TypeAlias = IdmParameters | DriverIdm
TABLE_V = IdmParameters()
#: A gap below this is treated as this one: the interaction term stays finite and asks for the hardest braking.
SMALLEST_GAP_M = 0.1


def desired_gap(
    speed: Tensor,
    closing_speed: Tensor,
    parameters: AnyIdm = TABLE_V,
    headway_s: Tensor | float | None = None,
) -> Tensor:
    """Gap in metres that a driver at ``speed`` wants to a leader it closes in on at ``closing_speed`` (m/s).

    The dynamic part is never negative, so a leader that pulls away does not invite tailgating.
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
        gap: net gap to the leader (bumper to bumper), m; Table V's 10 000 m where there is none.
            A gap of 0 or less (an overlap) gives the hardest braking.
        leader_speed: m/s; irrelevant where the gap is the free one, but for the approach term.
        parameters: everybody's, or each driver's own (:class:`DriverIdm`).
        headway_s: a time headway per vehicle in place of Table V's.
    """
    ratio = speed / desired_speed
    square = ratio * ratio
    wanted = desired_gap(speed, speed - leader_speed, parameters, headway_s)
    interaction = wanted / gap.clamp_min(SMALLEST_GAP_M)
    acceleration = parameters.max_acceleration * (1.0 - square * square - interaction * interaction)
    return acceleration.clamp(parameters.min_acceleration, parameters.max_acceleration)  # type: ignore[arg-type]


def equilibrium_gap(speed: Tensor, desired_speed: Tensor | float, parameters: IdmParameters = TABLE_V) -> Tensor:
    """Gap in metres at which a platoon at constant ``speed`` neither closes up nor opens (below desired speed)."""
    ratio = speed / desired_speed
    square = ratio * ratio
    return (parameters.min_gap_m + speed * parameters.headway_s) / torch.sqrt(1.0 - square * square)
