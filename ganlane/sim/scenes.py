"""Where the vehicles of an episode start: at random (Table II), or in a scene that somebody set.

Anything that is a :class:`Scenes` will do: it is called with the episode keys [N] and gives the first vehicles.
:class:`RandomScenes` draws them, :class:`~ganlane.sim.fixed_scene.FixedScene` holds vehicles set by hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ganlane.sim.idm import IdmParameters
from ganlane.sim.lanes import Visibility
from ganlane.sim.road import Road
from ganlane.sim.spawn import TABLE_II, SpawnParameters, spawn
from ganlane.sim.vehicles import Vehicles

STRAIGHT = Road()


class Scenes(Protocol):
    """Makes the first scene of every episode."""

    @property
    def vehicles(self) -> int:
        """M, the ego included."""
        ...

    def check(self, road: Road, idm: IdmParameters) -> None:
        """Raise :class:`UserError` where the scene does not suit the road, or nobody could drive on from it."""
        ...

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """The vehicles of the episodes with these keys [N] int64, fields [N, M]; the ego at index 0 and x = 0."""
        ...


@dataclass(frozen=True)
class RandomScenes:
    """Table II: random positions and speeds (:func:`ganlane.sim.spawn.spawn`)."""

    road: Road = STRAIGHT
    vehicles: int = 9
    parameters: SpawnParameters = TABLE_II
    ego_visibility: int = Visibility.BODY
    others_visibility: int = Visibility.SIGNALLED

    def check(self, road: Road, idm: IdmParameters) -> None:
        """See :meth:`SpawnParameters.check`."""
        if isinstance(road.lanes, int):
            self.parameters.check(self.vehicles, road.lanes, idm)

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """One random scene per key."""
        lanes, width = self.road.lanes, self.road.lane_width_m
        assert not isinstance(lanes, Tensor)
        assert not isinstance(width, Tensor)
        seen = (self.ego_visibility, self.others_visibility)
        return spawn(key, self.vehicles, lanes, float(width), self.parameters, dtype, *seen)
