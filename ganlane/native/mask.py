"""The action mask ``safe`` by the native kernel: what :class:`ganlane.transforms.ActionMaskTransform` says."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from ganlane.native.calls import addresses, in_threads
from ganlane.native.library import load
from ganlane.native.settings import safe_settings
from ganlane.parameters.driving import IdmParameters
from ganlane.sim.state import Road, Vehicles


class SafeActions:
    """Which lane changes have an effect and make no vehicle brake harder than is safe.

    Args:
        road: straight, the same in all rows.
        vehicles: M, the ego included.
        idm: by which braking is judged.
        safe_deceleration: m/s2.
        abort: whether the ego may turn back during a lane change.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.
    """

    def __init__(
        self,
        road: Road,
        vehicles: int,
        idm: IdmParameters,
        safe_deceleration: float,
        abort: bool,
        variant: str | None = None,
    ) -> None:
        self.variant = variant
        self._allow = load(variant).ganlane_mask
        assert not isinstance(road.lanes, Tensor)
        assert not isinstance(road.lane_width_m, Tensor)
        self._settings = safe_settings(road.lanes, road.lane_width_m, vehicles, idm, safe_deceleration, abort)

    def __getstate__(self) -> dict[str, Any]:
        """Without the library, which another process loads for itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_allow"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._allow = load(self.variant).ganlane_mask

    def allowed(self, seen: Vehicles, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The mask [N, 3], and whether no action is safe [N], of vehicles as the ego perceives them."""
        v = seen
        given = [v.x, v.y, v.heading, v.speed, v.length, v.width, v.desired_speed]
        given = [each.contiguous() for each in (*given, v.target_lane, v.visibility, v.valid, direction)]
        rows = v.x.shape[0]
        out = [torch.empty((rows, 3), dtype=torch.bool), torch.empty((rows,), dtype=torch.bool)]
        settings, inputs, outputs = ctypes.byref(self._settings), addresses(given, len(given)), addresses(out, 2)
        in_threads(rows, lambda first, last: self._allow(settings, inputs, outputs, first, last))
        return out[0], out[1]
