"""The state of all vehicles, as a record of tensors."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ganlane.keys import VEHICLE_FIELDS


class Vehicles(NamedTuple):
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
        """From a mapping of names to tensors, for example a TensorDict."""
        named = dict(mapping.items())
        return cls(*(named[name] for name in VEHICLE_FIELDS))

    def as_dict(self) -> dict[str, Tensor]:
        """Name to tensor, without copies."""
        return self._asdict()

    def with_(self, **changed: Tensor) -> Vehicles:
        """The same vehicles with some fields replaced."""
        return self._replace(**changed)

    def at(self, index: int) -> Vehicles:
        """Vehicle ``index`` of every row, fields [N]."""
        return Vehicles(*(field[:, index] for field in self))

    def columns(self, which: slice) -> Vehicles:
        """A slice of the vehicles of every row, fields [N, K]."""
        if which == slice(None):
            return self
        return Vehicles(*(field[:, which] for field in self))

    def with_first(self, first: Vehicles) -> Vehicles:
        """The same rows with vehicle 0 replaced by ``first`` (fields [N])."""
        is_first = torch.arange(self.x.shape[1], device=self.x.device) == 0
        return Vehicles(*(torch.where(is_first, one[:, None], all_) for one, all_ in zip(first, self)))

    def with_finite_padding(self) -> Vehicles:
        """The same vehicles with finite numbers in invalid entries, so that NaN does not spread through sums."""

        def finite(field: Tensor) -> Tensor:
            return torch.where(self.valid, field, torch.nan_to_num(field, 1.0, 1.0, 1.0))

        return Vehicles(*(finite(field) if field.is_floating_point() else field for field in self))

    def where(self, rows: Tensor, other: Vehicles) -> Vehicles:
        """These vehicles where ``rows`` ([N], [N, 1] or [N, M]) is true, ``other`` elsewhere."""
        mask = rows[:, None] if rows.ndim == 1 else rows
        return Vehicles(*(torch.where(mask, mine, theirs) for mine, theirs in zip(self, other)))
