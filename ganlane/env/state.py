"""The environment's state: fields, specs, and the start of an episode.

And what is handed in, checked.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.data.tensor_specs import Binary

from ganlane import keys
from ganlane.errors import UserError
from ganlane.keys import DONE_FLAGS, EGO_FLAGS, EGO_FLOATS, EGO_INTEGERS, EVENT_COUNTS
from ganlane.sim.state import Vehicles
from ganlane.torch_settings import check_default_device

COUNTERS = (keys.SEED, keys.EPISODE, keys.STEP)


def state_spec(
    n: int, m: int, dtype: torch.dtype, memory: dict[str, Any], own_roads: bool
) -> Composite:
    """Spec of everything that a step writes except done flags and reward.

    ``memory`` is the traffic's.
    """
    vehicles = _fields(
        (n, m), dtype, keys.VEHICLE_FLOATS, keys.VEHICLE_INTEGERS, keys.VEHICLE_FLAGS
    )
    parts = {
        keys.VEHICLES: Composite(vehicles, shape=(n,)),
        keys.EGO: Composite(_fields((n,), dtype, EGO_FLOATS, EGO_INTEGERS, EGO_FLAGS), shape=(n,)),
        keys.EVENTS: Composite(
            _fields((n, 1), dtype, (), EVENT_COUNTS, keys.END_EVENTS), shape=(n,)
        ),
        keys.TRAFFIC: _memory_spec(memory, n),
        **_fields((n,), dtype, (), COUNTERS, ()),
    }
    if own_roads:
        parts[keys.ROAD] = Composite(
            _fields((n, 1), dtype, ("lane_width_m",), ("lanes",), ()), shape=(n,)
        )
    return Composite(parts, shape=(n,))


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
        name: _memory_spec(value, n)
        if isinstance(value, dict)
        else Unbounded(shape=value[0], dtype=value[1])
        for name, value in memory.items()
    }
    return Composite(specs, shape=(n,))


def first_state(
    seed: Tensor, episode: Tensor, vehicles: Vehicles, memory: TensorDictBase
) -> TensorDictBase:
    """The state of episodes that begin, without roads of their own.

    ``seed`` and ``episode`` are [N].
    """
    zero = torch.zeros(seed.shape, dtype=vehicles.x.dtype, device=seed.device)
    integer, column = zero.long(), zero[:, None]
    ego = {name: zero for name in EGO_FLOATS} | {name: integer for name in EGO_INTEGERS}
    ego |= {name: zero.bool() for name in EGO_FLAGS}
    events = {name: column.bool() for name in keys.END_EVENTS} | {
        name: column.long() for name in EVENT_COUNTS
    }
    rest = {keys.SEED: seed, keys.EPISODE: episode, keys.STEP: torch.zeros_like(seed)}
    return pack(vehicles, ego, memory, events, rest | {name: column.bool() for name in DONE_FLAGS})


def pack(
    vehicles: Vehicles,
    ego: dict[str, Tensor],
    traffic: TensorDictBase,
    events: dict[str, Tensor],
    rest: dict,
) -> TensorDictBase:
    """The state as one TensorDict [N]; ``rest`` is not nested."""
    batch, device = ego["distance"].shape, ego["distance"].device
    nested = {keys.VEHICLES: vehicles.as_dict(), keys.EGO: ego, keys.EVENTS: events}
    made = {
        name: TensorDict._new_unsafe(value, batch_size=batch, device=device)
        for name, value in nested.items()
    }
    return TensorDict._new_unsafe(
        {**made, keys.TRAFFIC: traffic, **rest}, batch_size=batch, device=device
    )


# What is handed in


def check_counter(name: str, counter: Tensor | None, rows: int) -> Tensor:
    """``counter`` [N] int64 of a reset.

    :class:`UserError` if it is none, or of another shape or type.
    """
    if counter is None or counter.shape != (rows,) or counter.dtype != torch.int64:
        found = "missing" if counter is None else f"{list(counter.shape)} in {counter.dtype}"
        given = "next_episode" if name == "next_episode" else "'seed' and 'episode'"
        raise UserError(
            f"reset(): {name} is {found}; give {given} as int64 of shape [{rows}], or leave it out."
        )
    return counter


def usable_device(device: Any, dtype: Any) -> torch.device:
    """The device; :class:`UserError` where torch has no such device, or puts new tensors elsewhere,
    or for a type other than float32 and float64."""
    if dtype not in (torch.float32, torch.float64):
        raise UserError(
            f"dtype={dtype}: the simulation runs in torch.float32 or torch.float64; give one of them."
        )
    try:
        chosen = torch.empty(0, device=device or "cpu").device
    except (RuntimeError, AssertionError, TypeError) as error:
        raise UserError(f"device={device}: no such device here; use device='cpu'.") from error
    if chosen.type == "meta":
        raise UserError("device=meta: it holds no numbers; use device='cpu'.")
    check_default_device(chosen.type)
    return chosen


class ActionCheck:
    """Refuses actions other than 0, 1 and 2.

    The native kernel looks at their values itself, which costs nothing: there :meth:`form` is
    enough. On a GPU a step does not wait for the answer: it is looked at in later steps, when it
    has arrived.
    """

    def __init__(self, rows: int, device: torch.device) -> None:
        self.rows, self._shape = rows, torch.Size([rows])
        # Where a copy arrives by itself; elsewhere the answer is read at once.
        self._arrived = (
            torch.zeros((), dtype=torch.bool).pin_memory() if device.type == "cuda" else None
        )
        self._wrong = torch.zeros((), dtype=torch.bool, device=device)

    def form(self, action: Tensor | None) -> Tensor:
        """``action`` [N] as int64; :class:`UserError` for none, another shape, or no whole numbers."""
        if action is not None and action.dtype is torch.int64 and action.shape == self._shape:
            return action
        if action is None:
            raise UserError(
                f"step(): no action; give 'action' [{self.rows}], int64, from 0 to {keys.ACTIONS - 1}."
            )
        if action.shape != self._shape or action.is_floating_point() or action.dtype == torch.bool:
            raise _refused(f"of shape {list(action.shape)} in {action.dtype}", self.rows)
        return action.long()

    def values(self, action: Tensor) -> None:
        """Raise :class:`UserError` where ``action`` [N] int64 is not from 0 to 2."""
        if action.device.type == "cpu":
            # As unsigned numbers, in which those below 0 are large, and by NumPy: a few
            # microseconds.
            if action.numpy().view(np.uint64).max() >= keys.ACTIONS:
                raise _refused(
                    str(int(action[(action < 0) | (action >= keys.ACTIONS)][0])), self.rows
                )
        else:
            self._look_later(action)

    def _look_later(self, action: Tensor) -> None:
        if self._arrived is None:
            return
        if self._arrived:
            raise _refused("in an earlier step", self.rows)
        self._wrong |= ((action < 0) | (action >= keys.ACTIONS)).any()
        self._arrived.copy_(self._wrong, non_blocking=True)


def _refused(found: str, rows: int) -> UserError:
    return UserError(
        f"action {found}: expected {rows} whole numbers (int64, shape [{rows}]), each 0 (keep), 1 (left) or "
        "2 (right); correct the policy."
    )
