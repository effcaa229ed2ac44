"""The environment's state: its fields, their specs, and the start of an episode.

At the end: checks of what users hand in.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.data.tensor_specs import Binary

from ganlane import keys
from ganlane.errors import UserError
from ganlane.settings.actions import CONTROLS, LANE_SPEED, ActionParameters
from ganlane.sim.state import Vehicles
from ganlane.torch_settings import check_default_device

#: Name of a field to its type; None: the run's float type.
Fields: TypeAlias = Mapping[str, torch.dtype | None]

#: What is remembered of the ego from one decision to the next.
EGO: Fields = {
    **dict.fromkeys(keys.EGO_FLOATS),
    **dict.fromkeys(keys.EGO_INTEGERS, torch.int64),
    **dict.fromkeys(keys.EGO_FLAGS, torch.bool),
}
EVENTS: Fields = {
    **dict.fromkeys(keys.END_EVENTS, torch.bool),
    **dict.fromkeys(keys.EVENT_COUNTS, torch.int64),
}
DONE: Fields = dict.fromkeys(keys.DONE_FLAGS, torch.bool)


def spec_of(state: TensorDictBase) -> Composite:
    """Spec of such states, nested as this one."""
    specs: dict[str, Any] = {}
    for name, value in state.items():
        if isinstance(value, Tensor):
            # TorchRL checks flags by a spec of their own.
            spec = Binary if value.dtype == torch.bool else Unbounded
            specs[name] = spec(shape=value.shape, dtype=value.dtype)
        # TorchRL's SerialEnv and ParallelEnv refuse empty groups.
        elif not value.is_empty():
            specs[name] = spec_of(value)
    return Composite(specs, shape=state.batch_size)


def first_state(
    seed: Tensor,
    episode: Tensor,
    vehicles: Vehicles,
    memory: TensorDictBase,
    actions: ActionParameters,
) -> TensorDictBase:
    """The state of the episodes (``seed``, ``episode``) [N] that begin, without roads."""
    # Everything starts at 0, false, and no lane change.
    row = vehicles.x.new_zeros(seed.shape)
    column = row[:, None]
    ego = {name: row.to(kind or row.dtype) for name, kind in EGO.items()}
    if actions.form == LANE_SPEED:
        # The speed aimed at, m/s.
        ego[keys.SET_SPEED] = vehicles.desired_speed[:, keys.EGO_INDEX].clone()
    events = {name: column.to(kind) for name, kind in EVENTS.items()}
    done = {name: column.to(kind) for name, kind in DONE.items()}
    counters = {keys.SEED: seed, keys.EPISODE: episode, keys.STEP: torch.zeros_like(seed)}
    return pack(vehicles, ego, memory, events, {**counters, **done})


def pack(
    vehicles: Vehicles,
    ego: dict[str, Tensor],
    traffic: TensorDictBase,
    events: dict[str, Tensor],
    rest: dict[str, Any],
) -> TensorDictBase:
    """The state as one TensorDict [N]; ``rest`` is not nested."""
    # The first axis of every field is the batch.
    batch = ego["distance"].shape
    # In a graph, moving the traffic's part to its own device would be an error.
    device = None if torch.compiler.is_compiling() else ego["distance"].device
    nested = {keys.VEHICLES: vehicles.as_dict(), keys.EGO: ego, keys.EVENTS: events}
    parts: dict[str, Any] = {keys.TRAFFIC: traffic, **rest}
    for name, fields in nested.items():
        parts[name] = TensorDict._new_unsafe(fields, batch_size=batch, device=device)
    return TensorDict._new_unsafe(parts, batch_size=batch, device=device)


# Checks of what is handed in


def check_counter(name: str, counter: Tensor | None, rows: int) -> Tensor:
    """``counter`` [N] int64 of a reset.

    Raises:
        UserError: it is none, or of another shape or type.
    """
    # float counters would be rounded from 2**24 episodes on.
    if counter is None or counter.shape != (rows,) or counter.dtype != torch.int64:
        what = "missing" if counter is None else f"{list(counter.shape)} in {counter.dtype}"
        wanted = name if name == "next_episode" else "'seed' and 'episode'"
        raise UserError(
            f"reset(): {name} is {what}; give {wanted} as int64 of shape [{rows}], or leave it out."
        )
    return counter


def usable_device(device: Any, dtype: Any) -> torch.device:
    """The device of that name.

    Raises:
        UserError: torch has no such device or puts new tensors elsewhere, or ``dtype`` is neither
            float32 nor float64.
    """
    if dtype not in (torch.float32, torch.float64):
        raise UserError(
            f"dtype={dtype}: the simulation runs in torch.float32 or torch.float64; "
            "give one of them."
        )
    try:
        # torch itself knows which devices there are.
        chosen = torch.empty(0, device=device or "cpu").device
    except (RuntimeError, AssertionError, TypeError) as error:
        raise UserError(f"device={device}: no such device here; use device='cpu'.") from error
    if chosen.type == "meta":
        raise UserError("device=meta: it holds no numbers; use device='cpu'.")
    check_default_device(chosen.type)
    return chosen


def checked_action(
    action: Tensor | None, rows: int, actions: ActionParameters, values: bool = True
) -> Tensor:
    """``action`` [N] as int64, or [N, 2] for ``actions`` that are not numbered.

    ``values=False`` leaves out that of the values, which the native kernel looks at itself. It
    waits for a GPU's queue.

    Raises:
        UserError: there is none, or it has another shape, no whole numbers, others than the actions
            have, or one that is not finite.
    """
    if action is None:
        raise UserError(f"step(): no action; give 'action', {_expected(rows, actions)}.")
    if not actions.names:
        return _checked_controls(action, rows, actions)
    count = len(actions.names)
    # Flags and floats would be cast without a word.
    if action.shape != (rows,) or action.is_floating_point() or action.dtype == torch.bool:
        raise _refused(f"of shape {list(action.shape)} in {action.dtype}", rows, actions)
    action = action.long()
    if torch.compiler.is_compiling():
        # A graph cannot branch on values.
        legal = (action >= 0) & (action < count)
        torch._assert_async(legal.all(), f"action: each must be 0 to {count - 1}")
    elif values:
        # As unsigned numbers, of which those below 0 are large, and by NumPy: some microseconds.
        numbers = action.cpu().numpy()
        wrong = numbers.view(np.uint64) >= count
        if wrong.any():
            raise _refused(str(numbers[wrong][0]), rows, actions)
    return action


def _checked_controls(action: Tensor, rows: int, actions: ActionParameters) -> Tensor:
    if action.shape != (rows, CONTROLS) or not action.is_floating_point():
        raise _refused(f"of shape {list(action.shape)} in {action.dtype}", rows, actions)
    finite = torch.isfinite(action).all()
    if torch.compiler.is_compiling():
        torch._assert_async(finite, "action: each number must be finite")
    elif not finite:
        raise _refused("with a number that is not finite", rows, actions)
    return action


def _expected(rows: int, actions: ActionParameters) -> str:
    if not actions.names:
        return f"floats of shape [{rows}, {CONTROLS}] from -1 to 1"
    return f"{rows} whole numbers (int64, shape [{rows}]), each {actions.meanings()}"


def _refused(what: str, rows: int, actions: ActionParameters) -> UserError:
    return UserError(f"action {what}: expected {_expected(rows, actions)}; correct the policy.")
