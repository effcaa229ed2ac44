"""What makes drivers different from each other and stays with them: headway and desired speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ganlane.data import DrivingStatistics
from ganlane.generator.rollouts import recorded_vehicles
from ganlane.generator.stretches import RolloutScenes
from ganlane.generator.windows import PRESENT
from ganlane.sim.idm import TABLE_V
from ganlane.sim.neighbours import FREE_GAP_M, leader, perceive

#: Levels of the headway quantiles.
QUANTILE_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
#: Recorded followers' median (gap - 2 m) / speed on US-101, s: what is drawn from without other statistics.
HEADWAY_QUANTILES_S = (0.50, 0.93, 1.27, 1.93, 3.27)
#: Shortest headway that a recorded driver is credited with, s.
SHORTEST_HEADWAY_S = 0.1
#: Gap at standstill that the headway does not count (Table V), m.
_MIN_GAP_M = 2.0
#: Desired speed above the present one, m/s: range drawn from in fitting, and the middle used in evaluation.
DESIRED_EXCESS_MPS = (1.0, 11.0)
#: Everybody's desired speed where there are no traits: the middle of Table II's, m/s.
COMMON_SPEED_MPS = 22.0
#: In fitting the headways are scattered by this factor's logarithm, so that the network sees drivers off balance.
_SCATTER = 0.25


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


def balanced_headway(scenes: RolloutScenes, desired_speed: Tensor, otherwise: Tensor) -> Tensor:
    """The headway [B, V] in s at which IDM neither speeds up nor brakes at present; ``otherwise`` for the others.

    Looks at the present alone. Vehicles without a leader, or further behind it than the largest quantile, have
    shown no headway.
    """
    vehicles = recorded_vehicles(scenes, PRESENT, desired_speed)
    ahead = leader(perceive(vehicles, scenes.road), vehicles.target_lane.float())
    ratio = vehicles.speed / desired_speed
    settled = ahead.gap * torch.sqrt((1.0 - ratio * ratio * ratio * ratio).clamp_min(0.0))
    headway = (settled - _MIN_GAP_M) / vehicles.speed.clamp_min(1.0)
    shown = (ahead.gap < FREE_GAP_M) & (headway <= HEADWAY_QUANTILES_S[-1])
    return torch.where(shown, headway.clamp_min(SHORTEST_HEADWAY_S), otherwise)


def fitting_traits(scenes: RolloutScenes, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Random traits for fitting, [B, V] each: headways about the balanced ones, desired speeds above the present.

    Congested recordings do not show how fast a driver would like to go.
    """
    u = torch.rand(2, *scenes.length.shape, generator=random)
    scatter = torch.exp(_SCATTER * torch.randn(scenes.length.shape, generator=random))
    low, high = DESIRED_EXCESS_MPS
    desired = _present_speed(scenes) + low + (high - low) * u[0]
    return balanced_headway(scenes, desired, headway_from_uniform(u[1])) * scatter, desired


def common_traits(scenes: RolloutScenes) -> tuple[Tensor, Tensor]:
    """What everybody has where there are no traits (an ablation), [B, V] each: Table V's headway, 22 m/s."""
    headway = torch.full_like(scenes.length, TABLE_V.headway_s)
    return headway, torch.full_like(headway, COMMON_SPEED_MPS)


def typical_traits(scenes: RolloutScenes) -> tuple[Tensor, Tensor]:
    """Traits for evaluation, [B, V] each: the balanced headway or the median one, the middle desired speed."""
    desired = _present_speed(scenes) + 0.5 * sum(DESIRED_EXCESS_MPS)
    median = torch.full_like(desired, HEADWAY_QUANTILES_S[len(HEADWAY_QUANTILES_S) // 2])
    return balanced_headway(scenes, desired, median), desired


def _present_speed(scenes: RolloutScenes) -> Tensor:
    return recorded_vehicles(scenes, PRESENT, torch.ones_like(scenes.length)).speed
