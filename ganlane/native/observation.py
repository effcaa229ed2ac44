"""The lane view by the native kernel: what :func:`ganlane.transforms.observation.lane_view` says, in one pass."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from ganlane.native.calls import addresses, in_threads
from ganlane.native.library import load
from ganlane.native.settings import view_of
from ganlane.parameters.observation import ObservationScale
from ganlane.sim.state import Road, Vehicles


class LaneView:
    """Observations that consist of own state, lane view and own lane change.

    Args:
        road: straight, the same in all rows.
        vehicles: M, the ego included.
        scale: range of sight and of relative speeds.
        form: one of :data:`ganlane.native.settings.NATIVE_FORMS`.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.
    """

    def __init__(
        self,
        road: Road,
        vehicles: int,
        scale: ObservationScale,
        form: str,
        variant: str | None = None,
    ) -> None:
        self.variant = variant
        self._look = load(variant).ganlane_lane_view
        assert not isinstance(road.lanes, Tensor)
        assert not isinstance(road.lane_width_m, Tensor)
        self._view = view_of(road.lanes, road.lane_width_m, vehicles, scale, form)
        self.size = self._view.numbers()

    def __getstate__(self) -> dict[str, Any]:
        """Without the library, which another process loads for itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_look"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._look = load(self.variant).ganlane_lane_view

    def observe(self, vehicles: Vehicles, progress: Tensor, direction: Tensor, seen: Vehicles) -> Tensor:
        """The observation [N, size]; arguments as :meth:`ganlane.transforms.ObservationTransform.observe`."""
        v = vehicles
        given = [v.speed, v.desired_speed, v.length, v.y, seen.x, seen.y, seen.speed, seen.valid, progress, direction]
        given = [each.contiguous() for each in given]  # referred to until the call is over
        rows = v.x.shape[0]
        out = torch.empty((rows, self.size), dtype=torch.float32)
        view, inputs, outputs = ctypes.byref(self._view), addresses(given, len(given)), addresses([out], 1)
        in_threads(rows, lambda first, last: self._look(view, inputs, outputs, first, last))
        return out
