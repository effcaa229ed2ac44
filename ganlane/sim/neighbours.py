"""Leaders and followers, for all vehicles of all environments at once.

Everything works on pairs [N, K, M]: entry (i, j) is what observer i sees of vehicle j. All vehicles observe
(K = M), or a slice of them (the ego alone: K = 1).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.sim.lanes import LaneRange, body_lanes, presence, with_target
from ganlane.sim.road import Road
from ganlane.sim.vehicles import Vehicles

#: Table V's 'maximum gap for empty lane': stands for 'nobody there', m.
FREE_GAP_M = 10_000.0
#: Added to a gap that does not count, m: far beyond the free one, so that clamping gives exactly that.
_BEYOND_M = 1e9


class Neighbour(NamedTuple):
    """The nearest vehicle of a kind, per observer [N, K].

    ``gap`` is bumper to bumper, m, :data:`FREE_GAP_M` where there is nobody, negative for an overlap along
    the road; ``speed`` in m/s, the own speed where there is nobody.
    """

    gap: Tensor
    speed: Tensor


class Scene(NamedTuple):
    """What K observers see of M vehicles, computed once a step.

    ``observers`` and the lane ranges ``body`` and ``attention`` are theirs, [N, K]; ``presence`` [N, M] tells in
    which lanes each vehicle is seen; ``ahead`` and ``behind`` [N, K, M] hold the gap to every vehicle ahead of
    the observer (behind it), m, and :data:`FREE_GAP_M` for the others.
    """

    observers: Vehicles
    vehicles: Vehicles
    body: LaneRange
    attention: LaneRange
    presence: LaneRange
    ahead: Tensor
    behind: Tensor


def _only(gap: Tensor, counts: Tensor) -> Tensor:
    """``gap`` where ``counts`` holds, :data:`FREE_GAP_M` elsewhere.

    A sum in place of ``torch.where``: on a CPU that one branches at every element, which costs five times as much.
    Adding 0 leaves a gap as it is, to the last bit.
    """
    return (gap + (~counts) * _BEYOND_M).clamp_max(FREE_GAP_M)


def perceive(vehicles: Vehicles, road: Road, observers: slice = slice(None)) -> Scene:
    """The :class:`Scene` of ``vehicles`` on ``road``, as seen by all of them or by a slice of them.

    Of two vehicles at the same x the one of lower index is ahead.
    """
    body = body_lanes(vehicles, road)
    attention = with_target(body, vehicles)
    seen = presence(vehicles, road, body, attention)
    half = 0.5 * vehicles.length
    distance = road.distance_ahead(vehicles.x[:, observers, None], vehicles.x[:, None, :])
    bumpers = half[:, observers, None] + half[:, None, :]
    index = torch.arange(vehicles.x.shape[1], device=vehicles.x.device)
    tie = distance == 0
    is_ahead = (distance > 0) | (tie & (index[None, :] < index[observers, None]))
    is_behind = (distance < 0) | (tie & (index[None, :] > index[observers, None]))
    return Scene(
        observers=vehicles.columns(observers),
        vehicles=vehicles,
        body=LaneRange(*(lane[:, observers] for lane in body)),
        attention=LaneRange(*(lane[:, observers] for lane in attention)),
        presence=seen,
        ahead=_only(distance - bumpers, is_ahead),
        behind=_only(-distance - bumpers, is_behind),
    )


def in_lane(scene: Scene, lane: Tensor) -> Tensor:
    """Whether j stands in the lane ``lane`` [N, K] that observer i asks for; bool [N, K, M]."""
    asked = lane[:, :, None]
    return (scene.presence.low[:, None, :] <= asked) & (asked <= scene.presence.high[:, None, :])


def leader(scene: Scene, lane: Tensor) -> Neighbour:
    """The nearest vehicle ahead of each observer in its lane ``lane`` [N, K] (float); the slower of two as near."""
    candidates = _only(scene.ahead, in_lane(scene, lane))
    gap = candidates.amin(-1)
    speeds = scene.vehicles.speed[:, None, :] + (candidates > gap[..., None]) * _BEYOND_M
    return Neighbour(gap, torch.where(gap < FREE_GAP_M, speeds.amin(-1), scene.observers.speed))


class Follower(NamedTuple):
    """The nearest vehicle behind each observer [N, K]: gap (m), speed and desired speed (m/s), if there is one."""

    gap: Tensor
    speed: Tensor
    desired_speed: Tensor
    exists: Tensor


def follower(scene: Scene, lane: Tensor) -> Follower:
    """The nearest vehicle behind each observer in its lane ``lane`` [N, K] (float)."""
    candidates = _only(scene.behind, in_lane(scene, lane))
    gap, index = candidates.min(-1)
    return Follower(
        gap,
        scene.vehicles.speed.gather(1, index),
        scene.vehicles.desired_speed.gather(1, index),
        gap < FREE_GAP_M,
    )
