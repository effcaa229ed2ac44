"""What is seen of an episode beside its reward: near misses, comfort, and how a crash came about.

Near misses and comfort are looked at at the ends of decisions, not in between.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.lane_ends import hits_wall
from ganlane.sim.neighbours import leader, perceive
from ganlane.sim.state import STRAIGHT, Road, Vehicles, body_lanes, road_in

#: Columns of the smallest time to collision and headway with the vehicle ahead, and of the hardest
#: mean deceleration (0 or below) of a decision.
LEAST = ("least_ttc_s", "least_headway_s", "hardest_braking_mps2")
#: How a hard crash came about: the ego moved into the other, or was struck by one behind in the
#: lane that it had chosen, by one in the lane that it was leaving, or without changing lanes.
CRASHES = ("run_into", "cut_in", "leaving", "sitting")
#: A lane change that began at most so long before is what a crash came of, s: it takes some 4 s.
CHANGE_S = 6.0
#: The ego among the vehicles, as a slice that leaves a dimension.
_EGO = slice(0, 1)


def first_marks(rows: Tensor) -> TensorDict:
    """The marks of rows whose episode begins, for ``rows`` of any type, [N].

    Nothing has come near, nobody has braked, and the last lane change is endlessly long ago.

    Returns:
        :data:`LEAST` and ``change_s``, as :func:`marks_after` updates them, each [N].
    """
    endless = torch.full(rows.shape, torch.inf, device=rows.device)
    marks = dict.fromkeys(LEAST, endless)
    marks["hardest_braking_mps2"] = torch.zeros_like(endless)
    marks["change_s"] = -endless
    # Each mark gets a tensor of its own.
    return TensorDict(marks, rows.shape).clone()


def marks_after(state: TensorDictBase, marks: TensorDictBase, road: Road) -> TensorDictBase:
    """``marks`` [N] after the decision that led to ``state`` [N].

    Args:
        state: after the decision; one without ``vehicles`` says nothing of marks.
        marks: before it, of :func:`first_marks` or from here; not modified.
        road: where the state says nothing of its road.

    Returns:
        :data:`LEAST`, the smallest values of the episode so far, and ``change_s``, the time at
        which the last lane change began, s.
    """
    if keys.VEHICLES not in state:
        return marks

    ego = state[keys.EGO]
    vehicles = Vehicles.of(state[keys.VEHICLES])
    here = road_in(state, road)

    # The vehicle ahead of the ego in the lane of its centre, [N, 1].
    lane = here.lane_of(vehicles.y[:, _EGO])
    ahead = leader(perceive(vehicles, here, _EGO), lane)
    # Who overlaps along the road, half in the lane, is as near as can be.
    gap_m = ahead.gap[:, 0].clamp_min(0.0)
    speed = vehicles.speed[:, 0]
    closing = speed - ahead.speed[:, 0]
    # Who is no faster than the one ahead, or stands, comes no nearer.
    ttc_s = torch.where(closing > 0.0, gap_m / closing, torch.inf)
    headway_s = torch.where(speed > 0.0, gap_m / speed, torch.inf)

    now = {
        "least_ttc_s": ttc_s,
        "least_headway_s": headway_s,
        "hardest_braking_mps2": ego["mean_acceleration"],
    }
    updated = {name: torch.minimum(marks[name], value.float()) for name, value in now.items()}

    # The environment says at the end of a decision whether one began in it.
    time_s = state[keys.STEP] * keys.PHYSICS_STEP_S
    updated["change_s"] = torch.where(ego["started_change"], time_s.float(), marks["change_s"])
    return TensorDict(updated, marks.batch_size)


def crash_kinds(vehicles: Vehicles, since_s: Tensor, road: Road = STRAIGHT) -> list[str]:
    """One of :data:`CRASHES` for every row [N], as if it had crashed.

    Args:
        vehicles: [N, M], the ego first.
        since_s: time since the ego's last lane change began, s, [N].
        road: where they drive.
    """
    # Of the others, [N, M - 1].
    hit = ego_overlaps(vehicles, road)
    lanes = road.lane_of(vehicles.y[:, 1:])
    chosen_lane = vehicles.target_lane[:, _EGO]
    in_chosen_lane = (hit & (lanes == chosen_lane)).any(-1)

    # Indices into CRASHES. Soon after a change: struck in the lane chosen, or in the one left.
    struck = torch.where(in_chosen_lane, 1, 2)
    kind = torch.where(since_s <= CHANGE_S, struck, 3)
    # Whoever runs into somebody does so with or without a change.
    kind = torch.where(ego_at_fault(vehicles, road), 0, kind)
    return [CRASHES[number] for number in kind.tolist()]


def ego_at_fault(vehicles: Vehicles, road: Road = STRAIGHT) -> Tensor:
    """Whether the ego moved into somebody or a wall, [N] bool; false where it hit nothing.

    Along the road whoever is behind moves into the other, across it whoever is faster towards the
    other: a rule of geometry, no law. A driver that cuts in and is struck from behind is not at
    fault by it.

    Args:
        vehicles: [N, M], the ego first.
        road: where they drive.
    """
    # The others as seen from the ego, [N, M - 1].
    ahead = road.distance_ahead(vehicles.x[:, :1], vehicles.x[:, 1:])
    to_the_left = _gain(vehicles.y)
    along = vehicles.speed * torch.cos(vehicles.heading)
    across = vehicles.speed * torch.sin(vehicles.heading)

    # Two bodies met along the axis on which their extents began to overlap last. Headings are
    # small, so the axes are those of the road.
    since_along = _time_since(ahead, _gain(along), vehicles.length)
    since_across = _time_since(to_the_left, _gain(across), vehicles.width)

    # Across the road: who has the higher speed towards the other pushes.
    towards = torch.sign(to_the_left)
    pushes = towards * across[:, :1] > -towards * across[:, 1:]
    at_fault = torch.where(since_along < since_across, ahead > 0, pushes)
    into_somebody = (at_fault & ego_overlaps(vehicles, road)).any(-1)

    # Whoever hits the wall at the end of a lane has moved into it.
    if not road.has_lane_ends:
        return into_somebody
    ego = vehicles.columns(_EGO)
    into_wall = hits_wall(ego, body_lanes(ego, road), road)
    return into_somebody | into_wall[:, 0]


def _gain(values: Tensor) -> Tensor:
    """What the others have more than the ego, [N, M - 1], of ``values`` [N, M]."""
    return values[:, 1:] - values[:, :1]


def _time_since(distance: Tensor, speed: Tensor, sizes: Tensor) -> Tensor:
    """For how long the extents of the ego and the others overlap on an axis, s, [N, M - 1].

    Infinite where they do not close.

    Args:
        distance, speed: of the others relative to the ego on that axis, m and m/s, [N, M - 1].
        sizes: of all bodies, m, [N, M].
    """
    # Distance of two centres at which the bodies touch.
    reach = 0.5 * (sizes[:, 1:] + sizes[:, :1])
    # How fast they come nearer, below 0 where they part.
    closing = -torch.sign(distance) * speed
    # Both branches are computed, so the divisor is kept above 0.
    overlap_s = (reach - distance.abs()) / closing.clamp_min(1e-9)
    return torch.where(closing > 0, overlap_s, torch.inf)
