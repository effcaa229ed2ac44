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
    """TorchRL's spec of such states, nested as this one, without bounds."""
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
    """The state of the episodes (``seed``, ``episode``) [N] that begin, without roads.

    Args:
        seed, episode: counters, [N] int64.
        vehicles: the first scene of each, [N, M].
        memory: the traffic's.
        actions: what the ego remembers depends on them.
    """
    # Everything starts at 0, false, and no lane change.
    row = vehicles.x.new_zeros(seed.shape)
    column = row[:, None]
    ego = {name: row.to(kind or row.dtype) for name, kind in EGO.items()}
    if actions.form == LANE_SPEED:
        # The speed aimed at, m/s.
        ego[keys.SET_SPEED] = vehicles.desired_speed[:, keys.EGO_INDEX].clone()

    # TorchRL wants done flags, and with them events, as columns [N, 1].
    events = {name: column.to(kind) for name, kind in EVENTS.items()}
    done = {name: column.to(kind) for name, kind in DONE.items()}
    rest = {
        keys.SEED: seed,
        keys.EPISODE: episode,
        keys.STEP: torch.zeros_like(seed),
        **done,
    }
    return pack(vehicles, ego, memory, events, rest)


def pack(
    vehicles: Vehicles,
    ego: dict[str, Tensor],
    traffic: TensorDictBase,
    events: dict[str, Tensor],
    rest: dict[str, Any],
) -> TensorDictBase:
    """The state as one TensorDict [N].

    Args:
        vehicles, ego, events: [N, M], [N] and [N, 1]; each becomes a nested TensorDict.
        traffic: its memory, a TensorDict already.
        rest: what else the state has, by its key.
    """
    # The first axis of every field is the batch.
    batch = ego["distance"].shape
    # In a graph, moving the traffic's part to its own device would be an error.
    device = None if torch.compiler.is_compiling() else ego["distance"].device

    nested = {
        keys.VEHICLES: vehicles.as_dict(),
        keys.EGO: ego,
        keys.EVENTS: events,
    }
    parts: dict[str, Any] = {keys.TRAFFIC: traffic, **rest}
    for name, fields in nested.items():
        parts[name] = TensorDict._new_unsafe(fields, batch_size=batch, device=device)
    return TensorDict._new_unsafe(parts, batch_size=batch, device=device)


# Checks of what is handed in


def check_counter(name: str, counter: Tensor | None, rows: int) -> Tensor:
    """``counter`` [N] int64 of a reset, unchanged.

    Args:
        name: of the counter, for the message.
        rows: N.

    Raises:
        UserError: it is none, or of another shape or type.
    """
    # Float counters would be rounded from 2**24 episodes on.
    if counter is None or counter.shape != (rows,) or counter.dtype != torch.int64:
        what = "missing" if counter is None else f"{list(counter.shape)} in {counter.dtype}"
        # Seed and episode are handed in together.
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
    action: Tensor | None,
    rows: int,
    actions: ActionParameters,
    values: bool = True,
) -> Tensor:
    """``action`` [N] as int64, or [N, 2] for ``actions`` that are not numbered.

    Args:
        rows: N.
        values: whether to check the values of numbered actions too, which waits for a GPU's queue;
            the native kernel looks at them itself.

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
        # As unsigned numbers, of which those below 0 are large: one comparison is enough. By NumPy,
        # which saves some microseconds.
        numbers = action.cpu().numpy()
        wrong = numbers.view(np.uint64) >= count
        if wrong.any():
            raise _refused(str(numbers[wrong][0]), rows, actions)
    return action


def _checked_controls(action: Tensor, rows: int, actions: ActionParameters) -> Tensor:
    """``action`` [N, 2] of ``continuous``; raises as :func:`checked_action`."""
    if action.shape != (rows, CONTROLS) or not action.is_floating_point():
        raise _refused(f"of shape {list(action.shape)} in {action.dtype}", rows, actions)

    finite = torch.isfinite(action).all()
    if torch.compiler.is_compiling():
        torch._assert_async(finite, "action: each number must be finite")
    elif not finite:
        raise _refused("with a number that is not finite", rows, actions)
    return action


def _expected(rows: int, actions: ActionParameters) -> str:
    """What an action has to be, as part of a message."""
    if not actions.names:
        return f"floats of shape [{rows}, {CONTROLS}] from -1 to 1"
    return f"{rows} whole numbers (int64, shape [{rows}]), each {actions.meanings()}"


def _refused(what: str, rows: int, actions: ActionParameters) -> UserError:
    return UserError(f"action {what}: expected {_expected(rows, actions)}; correct the policy.")
