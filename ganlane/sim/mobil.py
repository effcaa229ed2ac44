"""MOBIL lane-changing model (Kesting et al. 2007) with the paper's Table IV."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ganlane.keys import EGO_INDEX
from ganlane.sim.following import acceleration_behind
from ganlane.sim.idm import TABLE_V, IdmParameters, idm_acceleration
from ganlane.sim.lanes import settled
from ganlane.sim.neighbours import FREE_GAP_M, Follower, Neighbour, Scene, follower, leader
from ganlane.sim.road import Road


@dataclass(frozen=True)
class MobilParameters:
    """Table IV. The politeness ``q`` weighs the old ('rear') follower, ``p`` the new ('side') one."""

    threshold: float = 0.1
    politeness_rear: float = 0.5
    politeness_side: float = 1.0
    safe_deceleration: float = 4.0
    #: Of several that want into one lane within this distance, only the foremost goes, m.
    exclusive_m: float = 60.0


TABLE_IV = MobilParameters()


class Change(NamedTuple):
    """What a change into one lane would bring, per observer [N, K]."""

    incentive: Tensor
    safe: Tensor


def _gap_over(behind: Follower, ahead: Neighbour, length: Tensor) -> Tensor:
    """Gap from the follower to the leader with the vehicle between them gone, m."""
    return torch.where(ahead.gap < FREE_GAP_M, behind.gap + length + ahead.gap, FREE_GAP_M)


def _follower_gain(scene: Scene, behind: Follower, ahead: Neighbour, idm: IdmParameters) -> tuple[Tensor, Tensor]:
    """Acceleration of a follower with the vehicle in front of it, and with the vehicle gone, m/s2."""
    vehicles = scene.observers
    with_it = idm_acceleration(behind.speed, behind.desired_speed, behind.gap, vehicles.speed, idm)
    free = ahead.gap >= FREE_GAP_M
    leader_speed = torch.where(free, behind.speed, ahead.speed)
    without = idm_acceleration(
        behind.speed, behind.desired_speed, _gap_over(behind, ahead, vehicles.length), leader_speed, idm
    )
    return with_it, without


def evaluate_change(
    scene: Scene, lane: Tensor, own: Tensor, relief: Tensor, idm: IdmParameters, mobil: MobilParameters
) -> Change:
    """Incentive and safety of a change into ``lane`` [N, K] (float).

    Args:
        own: acceleration in the present lane, m/s2.
        relief: what the old follower gains when the vehicle leaves, m/s2 (0 where there is none).
    """
    ahead, behind = leader(scene, lane), follower(scene, lane)
    new_own = acceleration_behind(scene, ahead, idm)
    with_it, without = _follower_gain(scene, behind, ahead, idm)
    burden = torch.where(behind.exists, with_it - without, 0.0)
    incentive = new_own - own + mobil.politeness_side * burden + mobil.politeness_rear * relief
    safe_behind = ~behind.exists | (with_it >= -mobil.safe_deceleration)
    return Change(incentive, safe_behind & (new_own >= -mobil.safe_deceleration))


def safe_change(
    scene: Scene, lane: Tensor, idm: IdmParameters = TABLE_V, mobil: MobilParameters = TABLE_IV
) -> Tensor:
    """Whether a change into ``lane`` [N, K] (float) asks nobody to brake harder than is safe, bool."""
    zero = torch.zeros_like(scene.observers.x)
    return evaluate_change(scene, lane, zero, zero, idm, mobil).safe


def on_road(lane: Tensor, road: Road) -> Tensor:
    """Whether ``lane`` exists, bool."""
    return (lane >= 0) & (lane <= road.lanes - 1)


def without_ego(wish: Tensor) -> Tensor:
    """``wish`` [N, M] with nothing wished by the ego: nobody can read its mind."""
    return torch.cat((torch.zeros_like(wish[:, : EGO_INDEX + 1]), wish[:, EGO_INDEX + 1 :]), dim=1)


def one_at_a_time(scene: Scene, wish: Tensor, road: Road, within_m: float) -> Tensor:
    """``wish`` (-1, 0, +1 lanes, [N, K]) less those whose lane somebody ahead takes within ``within_m``."""
    target = scene.observers.target_lane + wish
    wants = wish != 0
    same = wants[:, None, :] & wants[:, :, None] & (target[:, None, :] == target[:, :, None])
    half = 0.5 * scene.observers.length
    distance = scene.ahead + half[:, :, None] + half[:, None, :]
    taken = (same & (distance < within_m)).any(-1)
    return torch.where(taken, 0, wish)


def mobil_wishes(scene: Scene, road: Road, idm: IdmParameters = TABLE_V, mobil: MobilParameters = TABLE_IV) -> Tensor:
    """Lane change that each driver wishes for: -1 right, 0 none, +1 left, int64 [N, K].

    A driver in the middle of a change wishes for none. Where both sides pay, the better one is taken, the left
    one at a tie.
    """
    vehicles = scene.observers
    lane = vehicles.target_lane.to(vehicles.x.dtype)
    ahead, behind = leader(scene, lane), follower(scene, lane)
    own = acceleration_behind(scene, ahead, idm)
    with_it, without = _follower_gain(scene, behind, ahead, idm)
    relief = torch.where(behind.exists, without - with_it, 0.0)
    gains = []
    for side in (1.0, -1.0):
        change = evaluate_change(scene, lane + side, own, relief, idm, mobil)
        allowed = change.safe & on_road(lane + side, road) & (change.incentive > mobil.threshold)
        gains.append(torch.where(allowed, change.incentive, -torch.inf))
    left, right = gains
    free = settled(vehicles, road) & vehicles.valid
    wish = torch.where(left >= right, 1, -1)
    return torch.where(free & torch.isfinite(torch.maximum(left, right)), wish, 0)


def mobil_changes(
    scene: Scene, road: Road, idm: IdmParameters = TABLE_V, mobil: MobilParameters = TABLE_IV
) -> Tensor:
    """Lane change that each driver starts: as :func:`mobil_wishes`, with one vehicle per gap.

    The ego (vehicle 0) decides for itself: here it wishes for nothing, and holds nobody back.
    """
    return one_at_a_time(scene, without_ego(mobil_wishes(scene, road, idm, mobil)), road, mobil.exclusive_m)
