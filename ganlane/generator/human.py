"""A driver as one stochastic policy: what it perceives, how it decides, and how it remembers.

Every 0.4 s a driver perceives its neighbours, may begin a lane change or break one off, and draws
a change of its acceleration and of its lateral speed from distributions over tokens. Its style
(headway, restlessness, pace) is what its own history shows, so that drivers differ as recorded ones
do. There is no anchor, guard or clock. All inputs are relative: gaps, times, speed differences.

One decision, as in :meth:`ganlane.traffic.human.HumanTraffic.decide`::

    situation = situation_of(vehicles, memory, road)        # what drivers perceive and remember
    chances = policy.lane_chances(lane_choice(situation))   # whether to change lanes
    situation = with_choice(situation, chosen(chances, u))
    along, across = policy(features_of(situation))          # how to move: logits of tokens
    change = ALONG.sample(along, u_along)
    aside = ACROSS.sample(across, u_across)
    acceleration, lateral_speed = bounded(situation, change, aside)
    memory = remembered(situation, acceleration)

Shapes: N rows (environments, scenes or segments) of M vehicles. Left is positive across the road.
The same functions serve the fit (:mod:`ganlane.generator.human_fit`), its fine-tuning
(:mod:`ganlane.generator.human_tuning`) and the traffic (:mod:`ganlane.traffic.human`).
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.driving import Visibility
from ganlane.settings.generator import (
    ACROSS_TOKENS,
    ALONG_TOKENS,
    FEATURES,
    HUMAN_MEMORY,
    SIDE_FEATURES,
    HumanSizes,
)
from ganlane.sim.neighbours import Scene, nearest
from ganlane.sim.neighbours import perceive as scene_of
from ganlane.sim.state import LaneRange, Road, Vehicles

#: Physics steps of a decision, and its duration.
STEPS = 4
DECISION_S = STEPS * PHYSICS_STEP_S
#: Accelerations and lateral speeds that a driver remembers, one per decision.
ACCELERATIONS = HUMAN_MEMORY["accelerations"]
LATERAL_SPEEDS = HUMAN_MEMORY["lateral_speeds"]
#: Nobody is seen beyond this gap, m.
SIGHT_M = 150.0
#: Time constant of a driver's style, s.
STYLE_S = 6.0
#: Bounds of the acceleration, m/s2.
HARDEST_BRAKING = -8.0
STRONGEST_ACCELERATION = 3.5
#: Lateral speed at most, per speed along the road.
STEEPEST = 0.12
#: And its bound at any speed, m/s.
FASTEST_ASIDE_MPS = 2.0
#: A body reaches the edge of the road in this time at the soonest, s.
EDGE_S = 0.8
#: What is kept from the edge, m.
EDGE_M = 0.15
#: A driver looks this far ahead for the lane that another one is entering, s.
ANTICIPATION_S = 1.0
#: Decisions after which a driver's age, and the time since its last lane change, count no more.
LONGEST = 12.0
#: Decisions since the last lane change of a driver whose last one was not recorded.
LONG_AGO = 6.0
#: Lanes around a driver, as indices of the last dimension of :class:`Near`.
RIGHT, SAME, LEFT = range(3)
#: Sides in the order of a lane choice, with the sign of what is directed to them.
_SIDES = ((LEFT, 1.0), (RIGHT, -1.0))
#: What the driver behind, and the driver itself, would have to brake, among the numbers of a side.
REAR_BRAKING = 9
FRONT_BRAKING = 10
#: Standard deviation of the soft targets, in tokens.
BLUR = 0.7
#: The probabilities of both lane changes together are at most this.
_MOST_LIKELY = 0.98


class Tokens(NamedTuple):
    """Tokens of a change in physical units: dense around 0, sparse where changes are large.

    A value lies at ``asinh(value / scale)``, spaced evenly.

    Attributes:
        scale: value at which the spacing begins to grow.
        most: value of the outer token; that of the other outer one has the opposite sign.
        number: how many tokens there are.
    """

    scale: float
    most: float
    number: int

    @property
    def reach(self) -> float:
        """``asinh`` of the outer token."""
        return math.asinh(self.most / self.scale)

    def centres(self, like: Tensor) -> Tensor:
        """Values of the tokens [number], on the device and in the type of ``like``."""
        numbers = torch.arange(self.number, device=like.device)
        return self.value(numbers.to(like.dtype))

    def value(self, index: Tensor) -> Tensor:
        """Value at a real-valued index, from 0 to ``number - 1``."""
        # From -1 to 1.
        place = index / (self.number - 1) * 2.0 - 1.0
        return self.scale * torch.sinh(place * self.reach)

    def soft_target(self, value: Tensor) -> Tensor:
        """A distribution over the tokens around ``value`` [...], as probabilities [..., number]:
        a discrete Gaussian of :data:`BLUR` tokens.
        """
        # The value's real-valued index, from 0 to number - 1: the inverse of ``value``.
        reached = torch.asinh(value / self.scale).clamp(-self.reach, self.reach)
        index = (reached / self.reach + 1.0) * 0.5 * (self.number - 1)

        # Distances of all tokens from it, in standard deviations.
        numbers = torch.arange(self.number, device=value.device).to(value.dtype)
        distance = (numbers - index[..., None]) / BLUR
        return torch.softmax(-0.5 * distance * distance, -1)

    def sample(self, logits: Tensor, u: Tensor, temperature: float = 1.0) -> Tensor:
        """Values [...] that are drawn: the inverse of the distribution function, linear within a
        token.

        Args:
            logits: of the tokens, [..., number].
            u: uniform numbers [...].
            temperature: below 1, the distribution is sharper.
        """
        chance = torch.softmax(logits / temperature, -1)
        # The distribution function at the upper end of every token.
        upper = chance.cumsum(-1)

        # The token in which u lies; rounding may leave the last upper end below 1.
        token = (upper < u[..., None]).sum(-1, keepdim=True)
        token = token.clamp_max(self.number - 1)
        token_chance = chance.gather(-1, token)[..., 0].clamp_min(1e-9)
        token_lower = upper.gather(-1, token)[..., 0] - token_chance

        # Where in the token, from -0.5 to 0.5.
        within = ((u - token_lower) / token_chance).clamp(0.0, 1.0) - 0.5
        return self.value(token[..., 0] + within)

    def mean(self, logits: Tensor) -> Tensor:
        """The expected value [...] of ``logits`` [..., number]."""
        return torch.softmax(logits, -1) @ self.centres(logits)


#: Changes of the acceleration, m/s2, and of the lateral speed, m/s, from decision to decision.
ALONG = Tokens(0.15, 5.0, ALONG_TOKENS)
ACROSS = Tokens(0.04, 0.6, ACROSS_TOKENS)


class Memory(NamedTuple):
    """What a driver remembers, each [N, M, ...].

    Attributes:
        accelerations: of the last :data:`ACCELERATIONS` decisions, newest first, m/s2.
        lateral_speeds: before the present one, newest first, m/s.
        closing: speed of the leader less the own one at the last two decisions, m/s.
        style: logarithm of the headway in s, mean square of the acceleration, and speed relative to
            the neighbours in units of 3 m/s; means over :data:`STYLE_S`.
        age: decisions that the driver has been seen for.
        since: decisions since a lane change began or ended.
    """

    accelerations: Tensor
    lateral_speeds: Tensor
    closing: Tensor
    style: Tensor
    age: Tensor
    since: Tensor


def memory_of(accelerations: Tensor, lateral_speeds: Tensor, age: Tensor) -> Memory:
    """A memory [N, M] without style and closing speeds; the last lane change is long ago."""
    return Memory(
        accelerations,
        lateral_speeds,
        closing=age.new_zeros(*age.shape, HUMAN_MEMORY["closing"]),
        style=age.new_zeros(*age.shape, HUMAN_MEMORY["style"]),
        age=age,
        since=torch.full_like(age, LONG_AGO),
    )


class View(NamedTuple):
    """What drivers perceive of lanes, neighbours and their own motion.

    Attributes:
        speed: their own along the road, m/s, [N, M].
        aside: their own across the road, m/s, [N, M].
        lane: whose centre is nearest, [N, M], float.
        exists: whether there is a lane to the left, to the right, [N, M, 2].
        ahead: the nearest vehicles ahead in three lanes, [N, M, 3].
        behind: the nearest ones behind, [N, M, 3].
        log_headway: logarithm of the headway in s of drivers who follow, NaN for others, [N, M].
        relative_speed: over the mean of the neighbours, m/s, [N, M].
    """

    speed: Tensor
    aside: Tensor
    lane: Tensor
    exists: Tensor
    ahead: Near
    behind: Near
    log_headway: Tensor
    relative_speed: Tensor

    @property
    def gap(self) -> Tensor:
        """To the leader in the own lane, m, [N, M]."""
        return self.ahead.gap[..., SAME]

    @property
    def closing(self) -> Tensor:
        """Speed of the leader less the own one, m/s, [N, M]."""
        return self.ahead.closing[..., SAME]


class Near(NamedTuple):
    """The nearest vehicles in the lanes to the right, the own one, to the left, [N, M, 3].

    Where nobody is, the gap is :data:`SIGHT_M` and the rest 0.

    Attributes:
        gap: between the bumpers, m; below 0 for who is alongside.
        closing: its speed less the own one, m/s.
        acceleration: its own, m/s2.
        aside: how far to the left of the driver it is, m.
        lateral_speed: its own, m/s.
        exists: whether there is one.
        which: its index among the M vehicles.
    """

    gap: Tensor
    closing: Tensor
    acceleration: Tensor
    aside: Tensor
    lateral_speed: Tensor
    exists: Tensor
    which: Tensor


def velocity(vehicles: Vehicles) -> tuple[Tensor, Tensor]:
    """Speeds along and across the road, m/s, [N, M]."""
    along = vehicles.speed * torch.cos(vehicles.heading)
    across = vehicles.speed * torch.sin(vehicles.heading)
    return along, across


def lane_after(
    y: Tensor,
    aside: Tensor,
    road: Road,
    seconds: float,
) -> Tensor:
    """The lane that a vehicle is in some time later, at most the next one.

    Args:
        y: where it is across the road now, m.
        aside: its lateral speed, m/s.
        road: that it is on.
        seconds: how much later.
    """
    lane = road.lane_of(y)
    later = road.lane_of(y + seconds * aside)
    return later.clamp(lane - 1, lane + 1)


def perceive(vehicles: Vehicles, road: Road, sides: bool = True) -> View:
    """What every driver perceives now.

    Args:
        vehicles: fields [N, M]; nobody sees those that are not valid.
        road: that they are on.
        sides: without them a driver sees its own lane alone, as where only one lane was recorded.
    """
    speed, aside = velocity(vehicles)
    lane = road.lane_of(vehicles.y)

    # Who changes lanes is in both; absent vehicles are in none.
    soon = lane_after(vehicles.y, aside, road, ANTICIPATION_S)
    nowhere = torch.where(vehicles.valid, 0.0, torch.inf)
    rightmost = torch.minimum(lane, soon) + nowhere
    leftmost = torch.maximum(lane, soon)
    presence = LaneRange(rightmost, leftmost)
    scene = scene_of(vehicles, road)._replace(presence=presence)

    lanes = torch.stack((lane - 1, lane, lane + 1), -1)
    exists = torch.stack((lane + 1 < road.lanes, lane > 0), -1) & sides
    ahead = _nearest_on(1, scene, lanes, speed, aside, sides)
    behind = _nearest_on(-1, scene, lanes, speed, aside, sides)

    # Followers within 80 m show their headway. The bounds keep it finite where vehicles stand.
    gap = ahead.gap[..., SAME]
    follows = ahead.exists[..., SAME] & (gap < 80.0)
    headway_s = gap.clamp_min(0.5) / speed.clamp_min(2.0)
    log_headway = torch.log(headway_s.clamp(0.2, 6.0))
    log_headway = torch.where(follows, log_headway, torch.nan)

    # Over the up to six neighbours, [N, M, 6].
    seen = torch.cat((ahead.exists, behind.exists), -1)
    faster_by = -torch.cat((ahead.closing, behind.closing), -1)
    relative_speed = (faster_by * seen).sum(-1) / seen.sum(-1).clamp_min(1)

    return View(speed, aside, lane, exists, ahead, behind, log_headway, relative_speed)


def _nearest_on(
    side: int,
    scene: Scene,
    lanes: Tensor,
    speed: Tensor,
    aside: Tensor,
    sides: bool,
) -> Near:
    """The nearest vehicles ahead (``side`` 1) or behind (-1) in ``lanes`` [N, M, 3].

    ``speed`` and ``aside`` are the vehicles' :func:`velocity`; ``sides`` as in :func:`perceive`.
    """
    gap, index = nearest(scene, lanes, side)
    exists = gap < SIGHT_M
    if not sides:
        exists = exists & torch.tensor([False, True, False], device=gap.device)
    # Nobody's index may be beyond the last vehicle.
    which = torch.where(exists, index, 0)

    def of_nearest(number: Tensor) -> Tensor:
        """A number [N, M] of every vehicle, of those in ``which``: [N, M, 3]."""
        return number.gather(1, which.flatten(1)).view(gap.shape)

    vehicles = scene.vehicles
    closing = of_nearest(speed) - speed[..., None]
    to_the_left = of_nearest(vehicles.y) - vehicles.y[..., None]
    return Near(
        gap=torch.where(exists, gap, SIGHT_M),
        closing=torch.where(exists, closing, 0.0),
        acceleration=torch.where(exists, of_nearest(vehicles.acceleration), 0.0),
        aside=torch.where(exists, to_the_left, 0.0),
        lateral_speed=torch.where(exists, of_nearest(aside), 0.0),
        exists=exists,
        which=which,
    )


class Situation(NamedTuple):
    """Drivers at a decision, [N, M]: their vehicles, what they remember, and what they perceive."""

    vehicles: Vehicles
    memory: Memory
    road: Road
    view: View


def situation_of(
    vehicles: Vehicles,
    memory: Memory,
    road: Road,
    sides: bool = True,
    first: Tensor | None = None,
) -> Situation:
    """What drivers perceive now, with this decision's style in their memory.

    Args:
        vehicles: fields [N, M].
        memory: after the last decision.
        road: that they are on.
        sides: as in :func:`perceive`.
        first: as in :func:`with_style`.
    """
    view = perceive(vehicles, road, sides)
    memory = with_style(memory, view, first)
    return Situation(vehicles, memory, road, view)


def features_of(situation: Situation) -> Tensor:
    """What counts for the next move, [N, M, FEATURES]: 65 numbers without units, of order 1.

    The weights know them by their order, as does the native kernel.
    """
    view = situation.view
    features = [
        *_own_state(situation),
        *_leader_of_leader(view.ahead),
        *view.exists.to(view.speed.dtype).unbind(-1),
        *_room(situation),
        *_seen(view.ahead, view.speed),
        *_seen(view.behind, view.speed),
    ]
    return torch.stack(features, -1)


def _log_gap(gap: Tensor) -> Tensor:
    """The logarithm of a gap in m, as a feature: 0 at 10 m."""
    return torch.log(gap.clamp_min(0.5) / 10.0)


def _own_state(situation: Situation) -> list[Tensor]:
    """22 numbers of the driver itself and its place in the lane."""
    vehicles, memory, road, view = situation
    speed = view.speed
    target = vehicles.target_lane.to(speed.dtype)

    # To the left of the lanes' centres, m.
    from_target = vehicles.y - road.centre_of(target)
    from_centre = vehicles.y - road.centre_of(view.lane)

    return [
        # Motion along the road.
        speed / 10.0,
        ((vehicles.desired_speed - speed) / 5.0).clamp(-2.0, 2.0),
        # Standing and crawling, told apart finely.
        torch.tanh(speed / 2.0),
        *memory.accelerations.unbind(-1),
        *torch.asinh(memory.closing).unbind(-1),
        # Place and motion across the road; -1 and 1 are the edges of the lane.
        from_target.clamp(-4.0, 4.0),
        from_centre / road.lane_width_m * 2.0,
        (target - view.lane).clamp(-1.0, 1.0),
        view.aside * 2.0,
        *(memory.lateral_speeds * 2.0).unbind(-1),
        # Whether it is a lorry, what its memory is worth, and how it drives.
        (vehicles.length > 7.0).to(speed.dtype),
        memory.age.clamp_max(LONGEST) / LONGEST,
        memory.since.clamp_max(LONGEST) / LONGEST,
        *memory.style.unbind(-1),
    ]


def _leader_of_leader(ahead: Near) -> list[Tensor]:
    """3 numbers: gap and closing speed between the leader and its own leader; what the leader
    does.
    """
    leader = ahead.which[..., SAME]
    follows = ahead.exists[..., SAME]
    exists = follows & follows.gather(1, leader)

    # What the leader sees ahead of itself, gathered to who follows it, [N, M].
    gap = ahead.gap[..., SAME].gather(1, leader)
    gap = torch.where(exists, gap, SIGHT_M)
    closing = ahead.closing[..., SAME].gather(1, leader)
    closing = torch.where(exists, closing, 0.0)

    return [
        _log_gap(gap),
        torch.asinh(closing),
        ahead.acceleration[..., SAME] / 1.5,
    ]


def _room(situation: Situation) -> list[Tensor]:
    """8 numbers: room to those alongside, to the edges of the road, and where the leader is."""
    vehicles, _, road, view = situation
    ahead = view.ahead
    width = vehicles.width

    # Who is level with the driver, give or take 1 m; distances of the centres, m, 9 for nobody.
    numbers = []
    for side, sign in _SIDES:
        nearest_aside = torch.full_like(width, 9.0)
        alongside = torch.zeros_like(vehicles.valid)
        for near in (ahead, view.behind):
            beside = near.exists[..., side] & (near.gap[..., side] < 1.0)
            distance = torch.where(beside, sign * near.aside[..., side], 9.0)
            nearest_aside = torch.minimum(nearest_aside, distance)
            alongside = alongside | beside

        # Between the bodies, if the other one is as wide.
        room = nearest_aside - width
        numbers += [room.clamp(-0.5, 1.5), alongside.to(width.dtype)]

    # Between the body and the edges, m.
    to_left = road.left_edge_m() - vehicles.y - 0.5 * width
    to_right = vehicles.y - road.right_edge_m() - 0.5 * width
    return [
        *numbers,
        to_left.clamp(-0.5, 1.5),
        to_right.clamp(-0.5, 1.5),
        ahead.aside[..., SAME].clamp(-2.0, 2.0),
        ahead.lateral_speed[..., SAME].clamp(-1.0, 1.0),
    ]


def _seen(near: Near, speed: Tensor) -> tuple[Tensor, ...]:
    """15 numbers [N, M]: five kinds, each of the three neighbours in :class:`Near`'s order."""
    exists = near.exists.to(speed.dtype)
    # Nobody is as far away as can be seen: 2.7 is the logarithm of 150 m in units of 10 m.
    distance = exists * _log_gap(near.gap) + (1.0 - exists) * 2.7

    # The time in which the driver covers the gap, s; at least 3 m/s, for those who stand.
    pace = speed.clamp_min(3.0)[..., None]
    time_s = (near.gap / pace).clamp(-1.0, 5.0)

    # The reciprocal of the time to collision, 1/s.
    approach = (-near.closing / near.gap.clamp_min(2.0)).clamp(-1.0, 1.0)

    numbers = (
        distance,
        time_s * 0.5,
        torch.asinh(near.closing),
        approach * 3.0,
        exists,
    )
    return torch.stack(numbers, -2).flatten(-2).unbind(-1)


def _sides_of(situation: Situation) -> Tensor:
    """What counts for a lane change to the left and to the right, [N, M, 2, SIDE_FEATURES], in the
    same order for both: mirrored scenes have mirrored numbers.
    """
    vehicles, memory, road, view = situation
    speed = view.speed
    ahead = view.ahead
    behind = view.behind
    pace = speed.clamp_min(3.0)
    own_gap = _log_gap(view.gap)
    from_centre = vehicles.y - road.centre_of(view.lane)
    since = memory.since.clamp_max(LONGEST) / LONGEST

    # How much faster the lanes are, m/s, [N, M, 3]: on a free lane one could be faster by 3 m/s.
    gain = torch.where(ahead.exists, ahead.closing, 3.0).clamp(-5.0, 5.0)
    here = gain[..., SAME]

    # A change begins with a decision, not with the drift of a driver who keeps its lane: recorded
    # ones are found by how they move, which a choice of when to begin must not see.
    under_way = (vehicles.target_lane != view.lane).to(speed.dtype)

    sides = []
    for side, sign in _SIDES:
        # In the lane on this side: gaps, m, closing speeds and what there is to gain, m/s.
        front = ahead.gap[..., side]
        rear = behind.gap[..., side]
        front_closing = ahead.closing[..., side]
        rear_closing = behind.closing[..., side]
        there = gain[..., side]

        # How fast those who are near move across the road, to the left, m/s.
        front_aside = torch.where(front < 25.0, ahead.lateral_speed[..., side], 0.0)
        rear_aside = torch.where(rear < 15.0, behind.lateral_speed[..., side], 0.0)

        numbers = [
            # Room in the new lane and in the old one.
            torch.log1p(front.clamp_min(0.0)) - 2.5,
            torch.log1p(rear.clamp_min(0.0)) - 2.5,
            own_gap,
            (front / pace).clamp(-1.0, 4.0),
            (rear / pace).clamp(-1.0, 4.0),
            # What there is to gain, m/s.
            there / 3.0,
            rear_closing.clamp(-5.0, 5.0) / 3.0,
            here / 3.0,
            (there - here) / 3.0,
            # Danger: REAR_BRAKING, FRONT_BRAKING, bodies that nearly touch.
            _needed_braking(rear_closing, rear),
            _needed_braking(-front_closing, front),
            (1.5 - front).clamp(0.0, 2.0),
            (1.5 - rear).clamp(0.0, 2.0),
            # Motion towards the new lane, of the others and the driver's own.
            (sign * (front_aside + rear_aside)).clamp(-1.0, 1.0),
            (sign * view.aside * 3.0).clamp(-3.0, 3.0) * under_way,
            (sign * from_centre).clamp(-1.5, 1.5) * under_way,
            since,
        ]
        sides.append(torch.stack(numbers, -1))
    return torch.stack(sides, 2)


def leaves_room(side: Tensor, room_m: float = 2.0, hardest: float = 2.5) -> Tensor:
    """Whether a lane change leaves room and makes nobody brake hard; bool [...].

    Args:
        side: what counts for the change, [..., SIDE_FEATURES].
        room_m: gaps ahead and behind are larger than this, m.
        hardest: the braking that it asks for is below this, m/s2.
    """
    # The first two numbers of a side are its gaps ahead and behind, in this unit.
    least = math.log1p(room_m) - 2.5
    ahead = side[..., 0] > least
    behind = side[..., 1] > least
    braking = torch.maximum(side[..., REAR_BRAKING], side[..., FRONT_BRAKING])
    return ahead & behind & (braking < hardest)


def _needed_braking(closing: Tensor, gap: Tensor) -> Tensor:
    """Deceleration that keeps the rear one off the front one, m/s2, at most 8.

    It stops closing in over the gap but its last metre: v^2 / (2 s). ``closing`` is by how much the
    rear one is faster, m/s, ``gap`` in m.
    """
    distance = (gap - 1.0).clamp_min(0.3)
    braking = closing.clamp_min(0.0).square() / (2.0 * distance)
    return braking.clamp_max(8.0)


def layers(*widths: int) -> nn.Sequential:
    """Linear layers of these widths with SiLU between them."""
    parts: list[nn.Module] = []
    for before, after in pairwise(widths):
        parts += [nn.Linear(before, after), nn.SiLU()]
    # None after the last layer.
    return nn.Sequential(*parts[:-1])


class HumanPolicy(nn.Module):
    """Distributions of a driver's next move; below 50,000 weights.

    One network for both tokens, a small one of its own for lane changes, which are rare. It judges
    both sides alike, with two logits for each: to begin a change, and to break one off.

    Attributes:
        trunk: from features to what both tokens are read from.
        along: logits of the tokens :data:`ALONG`.
        across: logits of the tokens :data:`ACROSS`.
        lane: from what counts for a side to its two logits.
    """

    def __init__(self, sizes: HumanSizes) -> None:
        super().__init__()
        self.trunk = layers(FEATURES, sizes.hidden, sizes.hidden).append(nn.SiLU())
        self.along = nn.Linear(sizes.hidden, ALONG.number)
        self.across = nn.Linear(sizes.hidden, ACROSS.number)
        self.lane = layers(SIDE_FEATURES, sizes.lane_hidden, 2)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of the tokens :data:`ALONG` [..., 41] and :data:`ACROSS` [..., 31] from the
        features [..., FEATURES].
        """
        inner = self.trunk(features)
        return self.along(inner), self.across(inner)

    def lane_chances(self, choice: LaneChoice, factor: float = 1.0) -> Tensor:
        """Probabilities [..., 3]: to go on; to begin a change to the left, or break one off; to
        begin one to the right.

        Args:
            choice: what drivers could do.
            factor: of the probabilities to begin a change; traffic may have more or fewer of them.
        """
        to_begin, to_stop = self.lane(choice.sides).unbind(-1)

        # Of the changes to the left and to the right, [..., 2]; both together have a bound.
        begin = torch.sigmoid(to_begin) * choice.exists * (_MOST_LIKELY * factor)
        total = begin.sum(-1, keepdim=True).clamp_min(1e-9)
        begin = begin * (total.clamp_max(_MOST_LIKELY) / total)

        # Of the side to which a change is under way.
        to_stop = torch.where(choice.to_left, to_stop[..., 0], to_stop[..., 1])
        stop = torch.sigmoid(to_stop)

        # All of them have finite logarithms, which fine-tuning takes.
        first = torch.where(choice.keeping, begin[..., 0], stop).clamp_min(1e-9)
        second = torch.where(choice.keeping, begin[..., 1], 0.0).clamp_min(1e-9)
        go_on = (1.0 - first - second).clamp_min(1e-6)
        return torch.stack((go_on, first, second), -1)


class LaneChoice(NamedTuple):
    """What a lane choice depends on.

    Attributes:
        sides: what counts for a change to the left and to the right, [..., 2, SIDE_FEATURES].
        exists: whether there are lanes, [..., 2].
        keeping: whether the driver is in its target lane, [...].
        to_left: whether a change under way goes to the left, [...].
    """

    sides: Tensor
    exists: Tensor
    keeping: Tensor
    to_left: Tensor


def lane_choice(situation: Situation) -> LaneChoice:
    """The choice that each driver has."""
    target = situation.vehicles.target_lane
    lane = situation.view.lane.long()
    return LaneChoice(
        sides=_sides_of(situation),
        exists=situation.view.exists,
        keeping=target == lane,
        to_left=target > lane,
    )


def with_choice(situation: Situation, choice: Tensor) -> Situation:
    """The situation after a lane choice: who has chosen another lane heads for it.

    Args:
        situation: at the decision.
        choice: [N, M], 0, 1 or 2 as in :meth:`HumanPolicy.lane_chances`.
    """
    vehicles, memory, road, view = situation
    old = vehicles.target_lane
    lane = view.lane.long()

    # Who keeps its lane may begin a change; who is on its way may go back to its lane.
    step = (choice == 1).long() - (choice == 2).long()
    broken_off = torch.where(choice == 1, lane, old)
    target = torch.where(old == lane, old + step, broken_off)

    # The time since a change began or ended counts anew.
    since = torch.where(target != old, 0.0, memory.since)
    memory = memory._replace(since=since)
    return Situation(vehicles.with_(target_lane=target), memory, road, view)


def chosen(chances: Tensor, u: Tensor) -> Tensor:
    """A choice [N, M] with these ``chances`` [N, M, 3] from uniform numbers [N, M]."""
    # Choice 1 takes the lower end of [0, 1), choice 2 the upper one, 0 what is between them.
    first = u < chances[..., 1]
    second = u >= 1.0 - chances[..., 2]
    return first.long() + 2 * second.long()


def with_style(memory: Memory, view: View, first: Tensor | None = None) -> Memory:
    """The memory with this decision's style: an exponential mean over :data:`STYLE_S`.

    Args:
        memory: after the last decision.
        view: what drivers perceive now.
        first: drivers seen for the first time, who have closed in as they do now, [N, M]; None:
            there are none.
    """
    old = memory.style
    free = view.log_headway.isnan()

    # What the driver shows now, [N, M, 3]; without a leader its headway stays what it was.
    log_headway = torch.where(free, old[..., 0], view.log_headway)
    effort = memory.accelerations[..., 0].square()
    pace = (view.relative_speed / 3.0).clamp(-2.0, 2.0)
    shown = torch.stack((log_headway, effort, pace), -1)

    style = old + DECISION_S / STYLE_S * (shown - old)
    if first is None:
        return memory._replace(style=style)

    # Who follows nobody yet is taken to keep 2 s; everybody begins with a middling effort.
    log_headway = torch.where(free, math.log(2.0), view.log_headway)
    effort = torch.full_like(log_headway, 0.5)
    begun = torch.stack((log_headway, effort, pace), -1)

    first = first[..., None]
    return memory._replace(
        style=torch.where(first, begun, style),
        closing=torch.where(first, view.closing[..., None], memory.closing),
    )


def bounded(situation: Situation, change: Tensor, aside: Tensor) -> tuple[Tensor, Tensor]:
    """Acceleration and lateral speed at the end of the decision, from their drawn changes.

    Nobody rolls back, moves aside faster than a car can, or steers off the road: a body reaches the
    edge in :data:`EDGE_S` at the soonest, and comes back from beyond it.

    Args:
        situation: of drivers [N, M].
        change: of the acceleration since the last decision, m/s2, [N, M].
        aside: change of the lateral speed, m/s, [N, M].

    Returns:
        Accelerations, m/s2, and lateral speeds, m/s, [N, M].
    """
    vehicles, memory, road, view = situation

    acceleration = memory.accelerations[..., 0] + change
    acceleration = acceleration.clamp(HARDEST_BRAKING, STRONGEST_ACCELERATION)
    # At most to a stop.
    acceleration = torch.maximum(acceleration, -view.speed / DECISION_S)

    # Lateral speeds that reach the edges just then, m/s; below 0 where the body is beyond one.
    half = 0.5 * vehicles.width + EDGE_M
    to_left = (road.left_edge_m() - vehicles.y - half) / EDGE_S
    to_right = (vehicles.y - road.right_edge_m() - half) / EDGE_S
    lateral = torch.minimum(view.aside + aside, to_left)
    lateral = torch.maximum(lateral, -to_right)

    # A car turns no more sharply than this, even to come back from beyond an edge.
    most = (STEEPEST * view.speed).clamp_max(FASTEST_ASIDE_MPS)
    return acceleration, lateral.clamp(-most, most)


def remembered(situation: Situation, acceleration: Tensor) -> Memory:
    """The memory a decision later, of drivers who held this ``acceleration`` [N, M], m/s2."""
    _, memory, _, view = situation

    # Newest first; the oldest is forgotten.
    before = memory.accelerations[..., :-1]
    accelerations = torch.cat((acceleration[..., None], before), -1)
    lateral_speeds = torch.stack((view.aside, memory.lateral_speeds[..., 0]), -1)
    closing = torch.stack((view.closing, memory.closing[..., 0]), -1)

    return Memory(
        accelerations,
        lateral_speeds,
        closing,
        style=memory.style,
        age=memory.age + 1.0,
        since=memory.since + 1.0,
    )


def moved(vehicles: Vehicles, acceleration: Tensor, aside: Tensor) -> Vehicles:
    """The vehicles 0.4 s later, at a constant acceleration and an evenly changing lateral speed.

    Args:
        vehicles: at the decision, [N, M].
        acceleration: along the road, m/s2, [N, M].
        aside: lateral speed at the end, m/s, [N, M].
    """
    speed, lateral = velocity(vehicles)
    speed_later = (speed + acceleration * DECISION_S).clamp_min(0.0)
    # At the mean of the speeds before and after.
    x = vehicles.x + 0.5 * (speed + speed_later) * DECISION_S
    y = vehicles.y + 0.5 * (lateral + aside) * DECISION_S
    vehicles = vehicles.with_(x=x, y=y, acceleration=acceleration)
    return with_velocity(vehicles, speed_later, aside)


def cars(
    x: Tensor,
    y: Tensor,
    speed: Tensor,
    aside: Tensor,
    **others: Tensor,
) -> Vehicles:
    """Vehicles [N, M] at these speeds, which others see in the lanes where their centres are.

    Args:
        x: of the centres along the road, m.
        y: of the centres across the road, m.
        speed: along the road, m/s.
        aside: across the road, m/s.
        others: the further fields but heading and visibility; all vehicles are valid unless it says
            otherwise.
    """
    vehicles = Vehicles(
        x=x,
        y=y,
        heading=torch.zeros_like(x),
        speed=speed,
        visibility=torch.full(x.shape, int(Visibility.CENTRE), device=x.device),
        **{"valid": torch.ones_like(x, dtype=torch.bool), **others},
    )
    return with_velocity(vehicles, speed, aside)


def with_velocity(vehicles: Vehicles, along: Tensor, across: Tensor) -> Vehicles:
    """The vehicles at these speeds [N, M], m/s; nobody moves more aside than a fifth of its way
    ahead.
    """
    across = across.clamp(-0.2 * along, 0.2 * along)

    # Who stands keeps its heading.
    moves = along > 0.0
    heading = torch.where(moves, torch.atan2(across, along), vehicles.heading)
    speed = torch.where(moves, torch.hypot(along, across), 0.0)
    return vehicles.with_(speed=speed, heading=heading)
