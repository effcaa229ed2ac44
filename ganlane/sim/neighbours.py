"""Leaders and followers, for all vehicles of all environments at once.

Everything works on pairs [N, K, M]: entry (i, j) describes vehicle j relative to observer i. The observers are all
vehicles (K = M) or a slice of them (the ego alone: K = 1). Several lanes are evaluated at once: [N, K, L].
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.sim.lanes import LaneRange, body_lanes, presence, with_target
from ganlane.sim.state import Road, Vehicles

#: Gap in an empty lane, m (Table V's 'maximum gap for empty lane').
FREE_GAP_M = 10_000.0
#: Added to masked values, so that a minimum ignores them.
_BEYOND = 1e9
#: Breaks ties of position without changing any other distance, m.
_TIE_M = 1e-30


class Neighbour(NamedTuple):
    """The nearest vehicle of a kind, per observer and lane.

    ``gap`` is bumper to bumper, m, :data:`FREE_GAP_M` without a neighbour, negative for an overlap along
    the road; ``speed`` in m/s, the observer's speed without a neighbour.
    """

    gap: Tensor
    speed: Tensor


class Follower(NamedTuple):
    """The nearest vehicle behind, per observer and lane: gap (m), speed and desired speed (m/s), and whether it
    exists."""

    gap: Tensor
    speed: Tensor
    desired_speed: Tensor
    exists: Tensor


class Scene(NamedTuple):
    """Geometry of M vehicles relative to K observers, computed once per step.

    ``observers`` and the lane ranges ``body`` and ``attention`` are [N, K]; ``presence`` [N, M] holds the lanes in
    which others see each vehicle. ``distance`` [N, K, M] is the signed distance between the centres, m, and
    ``bumpers`` the sum of the two half lengths. ``order`` [N, K, M] is the distance with ties broken: of two
    vehicles at the same x the one with the lower index is ahead.
    """

    observers: Vehicles
    vehicles: Vehicles
    body: LaneRange
    attention: LaneRange
    presence: LaneRange
    distance: Tensor
    bumpers: Tensor
    order: Tensor

    @property
    def ahead(self) -> Tensor:
        """Gap to every vehicle ahead, m, [N, K, M]; :data:`FREE_GAP_M` for the others."""
        return _only(self.distance - self.bumpers, self.order > 0)

    @property
    def behind(self) -> Tensor:
        """Gap to every vehicle behind, m, [N, K, M]; :data:`FREE_GAP_M` for the others."""
        return _only(-self.distance - self.bumpers, self.order < 0)


def _beyond(number: Tensor, where: Tensor) -> Tensor:
    """Adds 1e9 where masked, so that ``min`` ignores it (branch-free ``where``).

    On a CPU ``torch.where`` branches at every element and takes five times as long. Adding 0 leaves a number
    unchanged to the last bit; NaN would stay NaN, so padding has to be finite.
    """
    return torch.add(number, where, alpha=_BEYOND)


def _only(gap: Tensor, counts: Tensor) -> Tensor:
    """``gap`` where ``counts`` holds, :data:`FREE_GAP_M` elsewhere."""
    return _beyond(gap, ~counts).clamp_max(FREE_GAP_M)


def perceive(vehicles: Vehicles, road: Road, observers: slice = slice(None)) -> Scene:
    """The :class:`Scene` of ``vehicles`` on ``road``, as seen by all of them or by a slice of them."""
    body = body_lanes(vehicles, road)
    attention = with_target(body, vehicles)
    half = 0.5 * vehicles.length
    distance = road.distance_ahead(vehicles.x[:, observers, None], vehicles.x[:, None, :])
    index = torch.arange(vehicles.x.shape[1], device=vehicles.x.device)
    tie = torch.sign(index[observers, None] - index[None, :]) * _TIE_M
    return Scene(
        observers=vehicles.columns(observers),
        vehicles=vehicles,
        body=body.columns(observers),
        attention=attention.columns(observers),
        presence=presence(vehicles, road, body, attention),
        distance=distance,
        bumpers=half[:, observers, None] + half[:, None, :],
        order=distance + tie,
    )


def in_lane(scene: Scene, lane: Tensor) -> Tensor:
    """Whether vehicle j is in ``lane`` of observer i; bool [N, K, M], or [N, K, L, M] for L lanes [N, K, L]."""
    low, high = (each[:, None, None, :] if lane.ndim == 3 else each[:, None, :] for each in scene.presence)
    asked = lane[..., None]
    return (low <= asked) & (asked <= high)


def leader(scene: Scene, lane: Tensor) -> Neighbour:
    """The nearest vehicle ahead of each observer in its lane (float; [N, K], or [N, K, L] for L of them).

    Of two at the same gap the slower one is taken.
    """
    if lane.ndim == 2:
        return Neighbour(*(found[..., 0] for found in leader(scene, lane[..., None])))
    candidates = _only(scene.ahead[:, :, None, :], in_lane(scene, lane))
    gap = candidates.amin(-1)
    speeds = _beyond(scene.vehicles.speed[:, None, None, :], candidates > gap[..., None])
    return Neighbour(gap, torch.where(gap < FREE_GAP_M, speeds.amin(-1), scene.observers.speed[..., None]))


def follower(scene: Scene, lane: Tensor) -> Follower:
    """The nearest vehicle behind each observer in its lane (float; [N, K], or [N, K, L] for L of them)."""
    if lane.ndim == 2:
        return Follower(*(found[..., 0] for found in follower(scene, lane[..., None])))
    gap, index = _only(scene.behind[:, :, None, :], in_lane(scene, lane)).min(-1)
    flat = index.flatten(1)
    speed, desired = (
        number.gather(1, flat).view_as(gap) for number in (scene.vehicles.speed, scene.vehicles.desired_speed)
    )
    return Follower(gap, speed, desired, gap < FREE_GAP_M)
