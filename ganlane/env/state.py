"""The environment's state: fields, specs, and the start of an episode."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.data.tensor_specs import Binary

from ganlane import keys
from ganlane.sim.state import Vehicles

#: Steering angle (rad), mean acceleration in the last decision (m/s2), lane change progress (0 to 1), distance (m).
EGO_FLOATS = ("steering", "mean_acceleration", "change_progress", "distance")
#: Direction of the current lane change (-1, 0, 1), decisions and started lane changes in this episode.
EGO_INTEGERS = ("change_direction", "decisions", "lane_changes")
#: Soft crash in the last physics step (ahead, behind), lane change started in the last decision.
EGO_FLAGS = ("soft_crash", "soft_crash_behind", "started_change")
EVENT_COUNTS = (keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)
DONE_FLAGS = ("done", "terminated", "truncated")
COUNTERS = (keys.SEED, keys.EPISODE, keys.STEP)


def state_spec(n: int, m: int, dtype: torch.dtype, memory: dict[str, Any], own_roads: bool = False) -> Composite:
    """Spec of everything that a step writes except done flags and reward; ``memory`` is the traffic's."""
    vehicles = _fields((n, m), dtype, keys.VEHICLE_FLOATS, keys.VEHICLE_INTEGERS, keys.VEHICLE_FLAGS)
    ego = _fields((n,), dtype, EGO_FLOATS, EGO_INTEGERS, EGO_FLAGS)
    events = _fields((n, 1), dtype, (), EVENT_COUNTS, keys.END_EVENTS)
    roads = {keys.ROAD: Composite(_fields((n, 1), dtype, ("lane_width_m",), ("lanes",), ()), shape=(n,))}
    return Composite(
        {
            **(roads if own_roads else {}),
            keys.VEHICLES: Composite(vehicles, shape=(n,)),
            keys.EGO: Composite(ego, shape=(n,)),
            keys.EVENTS: Composite(events, shape=(n,)),
            keys.TRAFFIC: _memory_spec(memory, n),
            **_fields((n,), dtype, (), COUNTERS, ()),
        },
        shape=(n,),
    )


def done_spec(n: int) -> Composite:
    """Spec of the done flags."""
    return Composite(_fields((n, 1), torch.float32, (), (), DONE_FLAGS), shape=(n,))


def _fields(
    shape: tuple[int, ...],
    dtype: torch.dtype,
    floats: tuple[str, ...],
    integers: tuple[str, ...],
    flags: tuple[str, ...],
) -> dict[str, Any]:
    specs: dict[str, Any] = {name: Unbounded(shape=shape, dtype=dtype) for name in floats}
    specs |= {name: Unbounded(shape=shape, dtype=torch.int64) for name in integers}
    return specs | {name: Binary(shape=shape, dtype=torch.bool) for name in flags}


def _memory_spec(memory: dict[str, Any], n: int) -> Composite:
    """Composite spec of a traffic module's memory, nested like the modules."""
    specs = {
        name: _memory_spec(value, n) if isinstance(value, dict) else Unbounded(shape=value[0], dtype=value[1])
        for name, value in memory.items()
    }
    return Composite(specs, shape=(n,))


def fresh_ego(zero: Tensor) -> dict[str, Tensor]:
    """Memory of an ego at the start of an episode; ``zero`` is a float tensor [N] of zeros."""
    fields = {name: zero for name in EGO_FLOATS} | {name: zero.long() for name in EGO_INTEGERS}
    return fields | {name: zero.bool() for name in EGO_FLAGS}


def no_events(zero: Tensor) -> dict[str, Tensor]:
    """Events [N, 1] before the first decision."""
    column = zero[:, None]
    return {name: column.bool() for name in keys.END_EVENTS} | {name: column.long() for name in EVENT_COUNTS}


def pack(
    vehicles: Vehicles, ego: dict[str, Tensor], traffic: TensorDictBase, events: dict[str, Tensor], rest: dict
) -> TensorDictBase:
    """The state as one TensorDict [N]; ``rest`` is not nested."""
    batch, device = ego["distance"].shape, ego["distance"].device
    nested = {keys.VEHICLES: vehicles.as_dict(), keys.EGO: ego, keys.EVENTS: events}
    made = {name: TensorDict._new_unsafe(value, batch_size=batch, device=device) for name, value in nested.items()}
    return TensorDict._new_unsafe({**made, keys.TRAFFIC: traffic, **rest}, batch_size=batch, device=device)


def where(rows: Tensor, new: TensorDictBase, old: TensorDictBase) -> TensorDictBase:
    """``new`` where ``rows`` [N] is true, ``old`` elsewhere, leaf by leaf."""

    def choose(fresh: Tensor, kept: Tensor) -> Tensor:
        return torch.where(rows.reshape(-1, *[1] * (fresh.ndim - 1)), fresh, kept)

    return new.apply(choose, old)
