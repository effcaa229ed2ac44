"""Initial vehicles of an episode: random (Table II) or hand-made.

A :class:`Scenes` is called with the episode keys [N] and returns the initial vehicles. :class:`RandomScenes` draws
them, :class:`~ganlane.sim.fixed_scene.FixedScene` holds hand-made ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.parameters.driving import IdmParameters, Visibility
from ganlane.parameters.episode import SpawnParameters
from ganlane.sim.road import Road
from ganlane.sim.spawn import TABLE_II, check_start, spawn
from ganlane.sim.vehicles import Vehicles

STRAIGHT = Road()


class Scenes(Protocol):
    """Makes the initial scene of every episode."""

    @property
    def vehicles(self) -> int:
        """M, the ego included."""
        ...

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle of all episodes, the ego included, m."""
        ...

    def check(self, road: Road, idm: IdmParameters) -> None:
        """Raise :class:`UserError` if the scene does not fit the road, or crashes are unavoidable."""
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
        """See :func:`ganlane.sim.spawn.check_start`; the road must be the scene's, wide and long enough."""
        if isinstance(road.lanes, Tensor) or isinstance(road.lane_width_m, Tensor):
            return  # a road for each row: its vehicles come from recordings
        if road != self.road:
            raise UserError(
                f"scenes: laid out on {_described(self.road)}, the traffic drives on {_described(road)}; give both "
                "the same road."
            )
        check_start(self.parameters, self.vehicles, road.lanes, idm)
        self._check_room(road.lane_width_m, road.ring_m)

    @property
    def longest_m(self) -> float:
        """Length of the longest vehicle of all episodes, m."""
        return self.parameters.longest_m

    def _check_room(self, lane_width_m: float, ring_m: float | None) -> None:
        """Check the room side by side, and where a ring closes: there the last vehicle is the first one's leader."""
        p = self.parameters
        if lane_width_m <= p.widest_m:
            wide = "width_m" if p.width_m == p.widest_m else "truck_width_m"
            raise UserError(
                f"env.lane_width_m={lane_width_m:g}: expected more than env.{wide}={p.widest_m:g}, or vehicles in "
                "neighbouring lanes touch; widen the lanes."
            )
        if ring_m is not None and p.spread_m + p.spacing_m > ring_m:
            more = f" ({p.spacing_m:g} with lorries)" if p.spacing_m > p.min_spacing_m else ""
            raise UserError(
                f"ring_m={ring_m:g}: expected at least env.spread_m={p.spread_m:g} and env.min_spacing_m="
                f"{p.min_spacing_m:g}{more} together, or the first vehicles overlap the last; lengthen the ring "
                "or lower env.spread_m."
            )

    def __call__(self, key: Tensor, dtype: torch.dtype) -> Vehicles:
        """One random scene per key."""
        lanes, width = self.road.lanes, self.road.lane_width_m
        assert not isinstance(lanes, Tensor)
        assert not isinstance(width, Tensor)
        seen = (self.ego_visibility, self.others_visibility)
        return spawn(key, self.vehicles, lanes, float(width), self.parameters, dtype, *seen)


def _described(road: Road) -> str:
    shape = "a straight road" if road.ring_m is None else f"a ring of {road.ring_m:g} m"
    return f"{shape} of {road.lanes} lanes of {road.lane_width_m} m"
