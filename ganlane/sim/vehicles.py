"""The state of all vehicles, as a record of tensors."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from ganlane.keys import FIXED_FIELDS, VEHICLE_FIELDS


@dataclass(frozen=True)
class Vehicles:
    """Fields of ``vehicles`` (:mod:`ganlane.keys`), each of shape [N, M] (or [N] for one vehicle per row)."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor
    acceleration: Tensor
    length: Tensor
    width: Tensor
    desired_speed: Tensor
    target_lane: Tensor
    visibility: Tensor
    valid: Tensor

    @classmethod
    def of(cls, mapping: Any) -> Vehicles:
        """From anything that ``get``s tensors by name, a TensorDict for one."""
        return cls(*(mapping.get(name) for name in VEHICLE_FIELDS))

    def as_dict(self) -> dict[str, Tensor]:
        """Name to tensor, without copies."""
        return {name: getattr(self, name) for name in VEHICLE_FIELDS}

    def with_(self, **changed: Tensor) -> Vehicles:
        """The same vehicles with some fields replaced."""
        return replace(self, **changed)

    def at(self, index: int) -> Vehicles:
        """Vehicle ``index`` of every row, fields [N]."""
        return Vehicles(*(getattr(self, field.name)[:, index] for field in fields(self)))

    def columns(self, which: slice) -> Vehicles:
        """A slice of the vehicles of every row, fields [N, K]."""
        return Vehicles(*(getattr(self, field.name)[:, which] for field in fields(self)))

    def with_first(self, first: Vehicles) -> Vehicles:
        """The same rows with vehicle 0 replaced by ``first`` (fields [N]), but for what never changes."""
        changing = {
            name: torch.cat((getattr(first, name)[:, None], getattr(self, name)[:, 1:]), dim=1)
            for name in VEHICLE_FIELDS
            if name not in FIXED_FIELDS
        }
        return self.with_(**changing)

    def where(self, rows: Tensor, other: Vehicles) -> Vehicles:
        """These vehicles in the rows [N] (or [N, 1], [N, M]) where ``rows`` holds, ``other`` elsewhere."""
        mask = rows[:, None] if rows.ndim == 1 else rows
        return Vehicles(*(torch.where(mask, getattr(self, name), getattr(other, name)) for name in VEHICLE_FIELDS))
