"""Whether a lane change has room for the next seconds, also if the others do not cooperate.

MOBIL's safety criterion looks at one instant, and relies on followers who brake by IDM. Here the
change is followed over :data:`HORIZON_S`, in which the body of the ego comes into its new lane:

- a follower in the new lane does not react: it keeps its speed;
- a leader there brakes until it stands, and after a reaction time the ego brakes as hard (the safe
  distance of Shalev-Shwartz, Shammah and Shashua 2017, with equal brakes);
- whoever is on the way into that lane, from the far side too, counts as being in it.

The ego meanwhile drives as slowly as its own lane and the new one let it.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from ganlane.sim.neighbours import Scene

#: A lane change takes about four seconds; in three the body is in the new lane alone.
HORIZON_S: Final = 3.0
#: Least gap that has to be left, bumper to bumper, m.
MARGIN_M: Final = 1.0
#: Before the ego brakes for its new leader, s: an action a second, so half of one on average.
REACTION_S: Final = 0.5
#: A vehicle is on its way into the lane in which it will be so much later, s.
DRIFT_S: Final = 1.0


def has_room(scene: Scene, lanes: Tensor, acceleration: Tensor, braking_mps2: float) -> Tensor:
    """Whether the ego, the only observer of ``scene``, has room in ``lanes``, bool [N, L].

    Args:
        scene: vehicles [N, M] as the ego sees them.
        lanes: [N, L], whole numbers as floats.
        acceleration: of the ego on the way into each lane, m/s2, [N, L]; above 0 it is not relied
            on.
        braking_mps2: of leader and ego, above 0.
    """
    others = scene.vehicles
    ego = scene.observers

    # [N, L, M]: who is in a lane, or on the way there.
    drifted = others.y + DRIFT_S * others.speed * torch.sin(others.heading)
    towards = scene.road.lane_of(drifted)
    low = torch.minimum(scene.presence.low, towards)[:, None]
    high = torch.maximum(scene.presence.high, towards)[:, None]
    lane = lanes[..., None]
    there = (low <= lane) & (lane <= high) & others.valid[:, None]
    # The ego is not in its own way.
    there[..., 0] = False

    # Bumper to bumper, [N, M].
    distance = scene.road.distance_ahead(ego.x, others.x)
    gap = distance.abs() - 0.5 * (ego.length + others.length)

    # The ego's way until it stands, or until the end of the horizon, m, [N, L].
    slows = acceleration.clamp_max(0.0)
    time = torch.where(slows < 0.0, ego.speed / -slows, HORIZON_S).clamp_max(HORIZON_S)
    way = ego.speed * time + 0.5 * slows * time * time

    # What is left of the gap to a follower at the end of the horizon ...
    behind = gap[:, None] + way[..., None] - HORIZON_S * others.speed[:, None]
    # ... and of that to a leader when both stand: v^2 / (2 b) is the way to a stop.
    stops = (others.speed**2 - ego.speed**2) / (2.0 * braking_mps2)
    ahead = gap + stops - REACTION_S * ego.speed

    # There has to be room now too.
    left = torch.where(distance[:, None] > 0, ahead[:, None], behind)
    room = torch.minimum(gap[:, None], left) >= MARGIN_M
    return (room | ~there).all(-1)
