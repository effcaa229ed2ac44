"""The guard: keeps generated vehicles on the road, in their lanes and off their leaders' bumpers.

A network with relative positions as its only input drifts: off the road within a minute, and to any speed. The guard
follows it and corrects its motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ganlane.parameters.driving import IdmParameters
from ganlane.sim.idm import TABLE_V, acceleration_behind
from ganlane.sim.neighbours import leader, perceive
from ganlane.sim.random import Stream
from ganlane.sim.state import Road, Vehicles, spanned
from ganlane.traffic.base import Memory, Moved, Overlay


@dataclass(frozen=True)
class GuardParameters:
    """Limits of the guard.

    Attributes:
        headway_s: time headway of the IDM acceleration that is the upper bound.
        slack: the lower bound is IDM's acceleration minus this, m/s2, times speed over desired speed, so that a
            network that always slows ends at a crawl instead of standing still on a free road.
        hardest_braking: lowest acceleration, m/s2.
        centring_per_s: rate at which the offset from the target lane's centre is reduced (the P of the PD).
        damping: share of the network's lateral motion that is kept (the D).
        edge_margin_m: minimum distance of the turned body from the edge of the road.
        steepest_rad: largest angle to the road.
    """

    headway_s: float = 0.8
    slack: float = 1.5
    hardest_braking: float = -8.0
    centring_per_s: float = 0.5
    damping: float = 0.8
    edge_margin_m: float = 0.1
    steepest_rad: float = 0.2


#: Called with the vehicles at t, as the chain moved them, and as the guard moves them.
Observer = Callable[[Vehicles, Vehicles, Vehicles], None]


class Guard(Overlay):
    """Bound the acceleration, pull towards the target lane, keep the body on the road.

    :attr:`observer`, if set, is called with every correction.
    """

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        guard: GuardParameters | None = None,
        idm: IdmParameters = TABLE_V,
    ) -> None:
        super().__init__(road, stream)
        self.guard, self.idm = guard or GuardParameters(), idm
        self.observer: Observer | None = None

    def bounds(self, vehicles: Vehicles, target_lane: Tensor) -> tuple[Tensor, Tensor]:
        """Lowest and highest acceleration allowed, m/s2, [N, M]."""
        g = self.guard
        scene = perceive(vehicles.with_(target_lane=target_lane), self.road)
        ahead = leader(scene, spanned(scene.attention))
        close = acceleration_behind(scene, ahead, self.idm, g.headway_s).amin(-1)
        normal = acceleration_behind(scene, ahead, self.idm).amin(-1)
        highest = close.clamp_min(g.hardest_braking)
        lowest = normal - g.slack * vehicles.speed / vehicles.desired_speed
        return torch.minimum(lowest.clamp_min(g.hardest_braking), highest), highest

    def along(self, vehicles: Vehicles, moved: Vehicles) -> Vehicles:
        """``moved`` with its acceleration inside the bounds."""
        lowest, highest = self.bounds(vehicles, moved.target_lane)
        wanted = (moved.speed - vehicles.speed) / self.dt
        acceleration = torch.minimum(torch.maximum(wanted, lowest), highest)
        speed = (vehicles.speed + acceleration * self.dt).clamp_min(0.0)
        altered = acceleration != wanted
        x = vehicles.x + 0.5 * (vehicles.speed + speed) * self.dt
        return moved.with_(
            speed=torch.where(altered, speed, moved.speed),
            acceleration=torch.where(altered, (speed - vehicles.speed) / self.dt, moved.acceleration),
            x=torch.where(altered, x, moved.x),
        )

    def across(self, vehicles: Vehicles, moved: Vehicles) -> Vehicles:
        """``moved`` pulled towards its lane's centre where it keeps a lane, and inside the edges everywhere."""
        g = self.guard
        centre = self.road.centre_of(moved.target_lane, moved.y.dtype)
        offset = centre - vehicles.y
        pulled = vehicles.y + g.damping * (moved.y - vehicles.y) + g.centring_per_s * self.dt * offset
        keeps = offset.abs() < 0.5 * self.road.lane_width_m
        y = torch.where(keeps, pulled, moved.y)
        half = 0.5 * moved.width
        left, right = self.road.left_edge_m() - g.edge_margin_m, self.road.right_edge_m() + g.edge_margin_m
        y = torch.minimum(torch.maximum(y, right + half), left - half)
        heading = torch.atan((y - vehicles.y) / ((moved.x - vehicles.x).clamp_min(0.1)))
        heading = torch.where(y == moved.y, moved.heading, heading)
        # A turned body is wider by half its length times the sine, which the angle exceeds.
        room = torch.minimum(left - y, y - right) - half
        steepest = (room / (0.5 * moved.length)).clamp(0.0, g.steepest_rad)
        return moved.with_(y=y, heading=torch.minimum(torch.maximum(heading, -steepest), steepest))

    def rewrite(self, vehicles: Vehicles, moved: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Along the road, then across it."""
        guarded = self.across(vehicles, self.along(vehicles, moved))
        if self.observer is not None:
            self.observer(vehicles, moved, guarded)
        return guarded, memory
