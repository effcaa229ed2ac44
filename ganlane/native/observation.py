"""The lane view by the native kernel: what :func:`ganlane.transforms.observation.lane_view` says, in one pass."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from ganlane.native.calls import addresses, in_threads
from ganlane.native.library import load
from ganlane.parameters.observation import ObservationScale
from ganlane.sim.state import Road, Vehicles


class _View(ctypes.Structure):
    """``View`` of observation.cpp."""

    _fields_ = (
        *((name, ctypes.c_float) for name in ("range", "speed_scale", "lane_width", "nearness_m", "overlap_m")),
        *((name, ctypes.c_int32) for name in ("lanes", "vehicles", "drift", "overlap")),
    )


class LaneView:
    """Observations that consist of own state, lane view and own lane change.

    Args:
        road: straight, the same in all rows.
        vehicles: M, the ego included.
        scale: range of sight and of relative speeds.
        nearness_m, overlap_m: scales of the nearness.
        drift, overlap: as in :func:`ganlane.transforms.observation.lane_view`.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.
    """

    def __init__(
        self,
        road: Road,
        vehicles: int,
        scale: ObservationScale,
        nearness_m: float,
        overlap_m: float,
        drift: bool = False,
        overlap: bool = False,
        variant: str | None = None,
    ) -> None:
        self.size = 5 + 6 * (4 if drift else 3)
        self.variant = variant
        self._look = load(variant).ganlane_lane_view
        self._view = _View(
            scale.range_m, scale.speed_mps, road.lane_width_m, nearness_m, overlap_m,
            road.lanes, vehicles, drift, overlap,
        )  # fmt: skip

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
