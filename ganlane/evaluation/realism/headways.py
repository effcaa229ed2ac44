"""Headways that drivers show at recorded starts.

A driver who was recorded behind a leader has shown how closely it follows. A headway drawn blind contradicts that:
half of the drivers would begin with hard braking, and the first seconds would measure nothing else. So a traffic
whose drivers each have a headway of their own (a memory ``headway`` [N, M] in s) starts with the ones that balance
the present gaps, as :func:`ganlane.generator.rollout.typical_driver_params` does where generators are evaluated.
Traffic whose headway is the same for everybody (IDM's Table V) keeps it: that is what its parameters say.
"""

from __future__ import annotations

from typing import Final

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane.generator.rollout import HEADWAY_QUANTILES_S, SHORTEST_HEADWAY_S
from ganlane.sim.idm import TABLE_V
from ganlane.sim.neighbours import FREE_GAP_M, leader, perceive
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles

#: Name of the memory.
HEADWAY: Final = "headway"


def balanced_headways(vehicles: Vehicles, road: Road, otherwise: Tensor) -> Tensor:
    """The headway [N, M] in s at which IDM (Table V) neither speeds up nor brakes; ``otherwise`` where none shows.

    Looks at gap, speed and desired speed. Vehicles without a leader, or further behind it than drivers follow, have
    shown no headway.
    """
    ahead = leader(perceive(vehicles, road), vehicles.target_lane.to(vehicles.x.dtype))
    ratio = vehicles.speed / vehicles.desired_speed
    settled = ahead.gap * torch.sqrt((1.0 - ratio * ratio * ratio * ratio).clamp_min(0.0))
    headway = (settled - TABLE_V.min_gap_m) / vehicles.speed.clamp_min(1.0)
    shown = (ahead.gap < FREE_GAP_M) & (headway <= HEADWAY_QUANTILES_S[-1])
    return torch.where(shown, headway.clamp_min(SHORTEST_HEADWAY_S), otherwise)


def with_shown_headways(memory: TensorDictBase, vehicles: Vehicles, road: Road, who: Tensor) -> TensorDictBase:
    """``memory`` in which the drivers ``who`` [N, M] have the headways that they show; one without any as it is.

    Args:
        memory: a traffic's, nested or not; not written.
        vehicles: in their recorded state.
        road: theirs.
        who: those who enter now.
    """

    def shown(name: str | tuple[str, ...], value: Tensor) -> Tensor:
        last = name if isinstance(name, str) else name[-1]
        return torch.where(who, balanced_headways(vehicles, road, value), value) if last == HEADWAY else value

    return memory.named_apply(shown, nested_keys=True)
