"""The first scenes of Table II by the native kernel: numbers of episodes in, tensors out."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from ganlane.native.calls import addresses, in_threads
from ganlane.native.decision import Outcome
from ganlane.native.library import load
from ganlane.native.settings import spawn_of
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Vehicles


class NativeScenes:
    """What :class:`~ganlane.sim.spawn.RandomScenes` draws, bit for bit, on a CPU in float32.

    Drawn by tensor code, the rows that ended took 3 of the 10 ms of a step of 4096 environments through TorchRL.

    Args:
        scenes: with a straight road, the same in all rows.
        stream: family of episodes.
        variant: one of :data:`ganlane.native.library.VARIANTS`; None: the best for this processor.

    Raises:
        UserError: the kernel cannot be built.
    """

    def __init__(self, scenes: RandomScenes, stream: int, variant: str | None = None) -> None:
        road, seen = scenes.road, (scenes.ego_visibility, scenes.others_visibility)
        assert not isinstance(road.lanes, Tensor)
        assert not isinstance(road.lane_width_m, Tensor)
        self.vehicles, self.variant = scenes.vehicles, variant
        shape = (road.lanes, road.lane_width_m, scenes.vehicles)
        self._settings = spawn_of(*shape, scenes.parameters, stream, *seen, recycle_share=None)
        self._spawn = load(variant).ganlane_spawn

    def __getstate__(self) -> dict[str, Any]:
        """Without the library, which another process loads for itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_spawn"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._spawn = load(self.variant).ganlane_spawn

    def start(self, seed: Tensor, episode: Tensor, rows: Tensor | None = None) -> tuple[Outcome, Vehicles]:
        """The first states of the episodes (``seed``, ``episode``) [N] int64.

        Args:
            seed, episode: of every row.
            rows: those to be drawn, [N] bool; None: all. The others are zeros, without a vehicle.
        """
        count = seed.shape[0]
        rows = torch.ones(count, dtype=torch.bool) if rows is None else rows.contiguous()
        out = Outcome.empty(count, self.vehicles, torch.zeros)
        length, width, desired_speed = (torch.zeros_like(out.x) for _ in range(3))
        visibility, valid = torch.zeros_like(out.target_lane), torch.zeros_like(out.x, dtype=torch.bool)
        recycles = torch.zeros(count, dtype=torch.bool)
        given = [
            seed.contiguous(),
            episode.contiguous(),
            rows,
            length,
            width,
            desired_speed,
            visibility,
            valid,
            recycles,
        ]
        spawn, settings = self._spawn, ctypes.byref(self._settings)
        scene, state = addresses(given, len(given)), addresses(out, len(out))
        in_threads(count, lambda first, last: spawn(settings, scene, state, first, last))
        moving = (out.x, out.y, out.heading, out.speed, out.acceleration)
        return out, Vehicles(*moving, length, width, desired_speed, out.target_lane, visibility, valid)
