"""Who is there: entering, waiting and leaving by the script of recordings driven side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ganlane.evaluation.realism.recordings import Recording
from ganlane.sim.lanes import ENTRY_M
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles
from ganlane.traffic.base import TrafficModule

#: A vehicle enters only where the gaps to those ahead and behind in its lane are at least this, m.
ENTRY_GAP_M = 2.0
#: Nobody wants to drive slower or faster than this, m/s.
SLOWEST_DESIRED_MPS, FASTEST_DESIRED_MPS = 5.0, 35.0
#: Where those are who are not there.
_PARKED_M = -10_000.0
#: Positions are good to this, m.
_ROUNDING_M = 0.01
_FIELDS = ("x", "y", "speed")


@dataclass(frozen=True)
class Script:
    """The recordings of a batch, padded.

    Attributes:
        x, y, speed, present: [T, N, M]; index 0 is nobody.
        length, driven: [N, M].
        end_m: [N, 1] where each road ends, m.
    """

    x: Tensor
    y: Tensor
    speed: Tensor
    present: Tensor
    length: Tensor
    driven: Tensor
    end_m: Tensor

    @classmethod
    def of(cls, rows: Sequence[Recording]) -> Script:
        """The recordings side by side, padded with nobody."""
        steps, most = max(len(row.x) for row in rows), max(len(row.length) for row in rows)

        def padded(name: str) -> Tensor:
            values = [getattr(row, name) for row in rows]
            whole = np.zeros((*([steps] if values[0].ndim == 2 else []), len(rows), most + 1), dtype=values[0].dtype)
            for index, value in enumerate(values):
                where = (slice(len(value)), index) if value.ndim == 2 else (index,)
                whole[(*where, slice(1, value.shape[-1] + 1))] = value
            made = torch.from_numpy(whole)
            return made.float() if made.is_floating_point() else made

        x, y, speed = padded("x"), padded("y"), padded("speed")
        end_m = torch.tensor([[row.end_m] for row in rows])
        return cls(x, y, speed, padded("present"), padded("length"), padded("driven"), end_m)


def parked(script: Script, traffic: TrafficModule) -> Vehicles:
    """Nobody is there yet."""
    zero = torch.zeros_like(script.x[0])
    lane = torch.zeros_like(script.present[0], dtype=torch.int64)
    return Vehicles(
        x=zero + _PARKED_M,
        y=zero,
        heading=zero,
        speed=zero + 10.0,
        acceleration=zero,
        length=script.length.clamp_min(1.0),
        width=zero + 2.0 * ENTRY_M,
        desired_speed=zero + 20.0,
        target_lane=lane,
        visibility=lane + int(traffic.visibility),
        valid=torch.zeros_like(script.present[0]),
    )


def leave(script: Script, state: Vehicles, step: int) -> Vehicles:
    """Whose recording is over, or who has passed the end of the road, is not there any more; replays go on."""
    on_road = (state.x <= script.end_m + _ROUNDING_M) | ~script.driven
    stays = state.valid & script.present[step] & on_road
    state = state.with_(valid=stays, x=torch.where(stays, state.x, _PARKED_M))
    replayed = stays & ~script.driven
    shown = {name: torch.where(replayed, getattr(script, name)[step], getattr(state, name)) for name in _FIELDS}
    return state.with_(**shown)


def enters(script: Script, state: Vehicles, waiting: Tensor, road: Road, step: int) -> Tensor:
    """Who enters now, bool [N, M]: recorded in this frame, not yet there, and with room in its lane."""
    wants = script.present[step] & waiting
    # On a CPU asking costs nothing, and mostly nobody wants to.
    if step == 0 or not bool(wants.any()):
        return wants
    same = road.lane_of(script.y[step])[:, :, None] == road.lane_of(state.y)[:, None]
    between = (script.x[step][:, :, None] - state.x[:, None]).abs()
    room = between - 0.5 * (script.length[:, :, None] + state.length[:, None])
    return wants & ~(same & state.valid[:, None] & (room < ENTRY_GAP_M)).any(-1)


def enter(
    script: Script, state: Vehicles, enters: Tensor, excess: Tensor, traffic: TrafficModule, step: int
) -> Vehicles:
    """Those who enter, in their recorded state, driving along the road; the rest as they are."""
    x, y, speed = script.x[step], script.y[step], script.speed[step].clamp_min(0.0)
    entered = state.with_(
        x=x,
        y=y,
        speed=speed,
        heading=torch.zeros_like(x),
        acceleration=torch.zeros_like(x),
        desired_speed=(speed + excess).clamp(SLOWEST_DESIRED_MPS, FASTEST_DESIRED_MPS),
        target_lane=traffic.road.lane_of(y).long(),
        valid=enters,
    )
    return entered.where(enters, state)
