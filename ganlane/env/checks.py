"""What :class:`~ganlane.env.HighwayEnv` is made of and what it is given, checked before anything is allocated."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.keys import ACTIONS
from ganlane.torch_settings import check_default_device


def check_counter(name: str, counter: Tensor | None, rows: int) -> Tensor:
    """``counter`` [N] int64 of a reset; :class:`UserError` if it is none, or of another shape or type."""
    if counter is None or counter.shape != (rows,) or counter.dtype != torch.int64:
        found = "missing" if counter is None else f"{list(counter.shape)} in {counter.dtype}"
        given = "next_episode" if name == "next_episode" else "'seed' and 'episode'"
        raise UserError(f"reset(): {name} is {found}; give {given} as int64 of shape [{rows}], or leave it out.")
    return counter


def usable_device(device: Any, dtype: Any) -> torch.device:
    """The device, which torch's tensors can be on.

    Raises:
        UserError: there is no such device here, torch puts new tensors elsewhere, or a type other than float32 and
            float64.
    """
    if dtype not in (torch.float32, torch.float64):
        raise UserError(f"dtype={dtype}: the simulation runs in torch.float32 or torch.float64; give one of them.")
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

    The native kernel looks at their values itself, which costs nothing: there :meth:`form` is enough.
    On a GPU a step does not wait for the answer: it is looked at in later steps, when it has arrived.

    Args:
        rows: N.
        device: of the actions.
    """

    def __init__(self, rows: int, device: torch.device) -> None:
        self.rows, self._shape = rows, torch.Size([rows])
        # Where a copy arrives by itself; elsewhere the answer is read at once.
        self._arrived = torch.zeros((), dtype=torch.bool).pin_memory() if device.type == "cuda" else None
        self._wrong = torch.zeros((), dtype=torch.bool, device=device)

    def form(self, action: Tensor | None) -> Tensor:
        """``action`` [N] as int64.

        Raises:
            UserError: there is none, it has another shape, or it is not a whole number.
        """
        if action is not None and action.dtype is torch.int64 and action.shape == self._shape:
            return action
        if action is None:
            raise UserError(f"step(): no action; give 'action' [{self.rows}], int64, from 0 to {ACTIONS - 1}.")
        if action.shape != self._shape or action.is_floating_point() or action.dtype == torch.bool:
            raise _refused(f"of shape {list(action.shape)} in {action.dtype}", self.rows)
        return action.long()

    def values(self, action: Tensor) -> None:
        """Raise :class:`UserError` where ``action`` [N] int64 is not from 0 to 2."""
        if action.device.type == "cpu":
            # As unsigned numbers, in which those below 0 are large, and by NumPy: a few microseconds.
            if action.numpy().view(np.uint64).max() >= ACTIONS:
                raise _refused(str(int(action[(action < 0) | (action >= ACTIONS)][0])), self.rows)
        else:
            self._look_later(action)

    def _look_later(self, action: Tensor) -> None:
        if self._arrived is None:
            return
        if self._arrived:
            raise _refused("in an earlier step", self.rows)
        self._wrong |= ((action < 0) | (action >= ACTIONS)).any()
        self._arrived.copy_(self._wrong, non_blocking=True)


def _refused(found: str, rows: int) -> UserError:
    return UserError(
        f"action {found}: expected {rows} whole numbers (int64, shape [{rows}]), each 0 (keep), 1 (left) or "
        "2 (right); correct the policy."
    )
