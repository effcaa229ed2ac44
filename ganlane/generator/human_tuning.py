"""Fine-tuning of ``human`` in simulation: nobody collides, leaves the road or stands without need.

Proximal policy optimisation (Schulman et al. 2017) of all drivers at once in random scenes, for a
cost that recordings cannot teach, since nobody in them has an accident. Among them are strangers,
whom the policy does not drive: slow ones, ones who brake, ones who push in, as an agent may. A pull
to the cloned policy (the divergence of both) keeps everything else as recorded, and a penalty keeps
the rate of lane changes, which carries over between roads per second rather than per kilometre.

One iteration: :func:`random_scenes`, :func:`drive` for T decisions of N scenes with M vehicles,
:func:`costs` of each decision, :func:`advantages`, and two passes over them in :func:`tune`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss, softplus

from ganlane.generator.descent import descend
from ganlane.generator.human import (
    ACCELERATIONS,
    ACROSS,
    ALONG,
    DECISION_S,
    FEATURES,
    HARDEST_BRAKING,
    SIDE_FEATURES,
    HumanPolicy,
    LaneChoice,
    Memory,
    bounded,
    cars,
    features_of,
    lane_choice,
    layers,
    leaves_room,
    memory_of,
    moved,
    perceive,
    remembered,
    situation_of,
    velocity,
    with_choice,
    with_style,
)
from ganlane.generator.human_samples import DESIRED_MPS, Choices, draws
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.neighbours import compare
from ganlane.sim.neighbours import perceive as scene_of
from ganlane.sim.state import Road, Vehicles

#: Called after every step of a fit, with its cost if it is one of the fine-tuning.
Report = Callable[[float | None], None]

# One iteration.
#: Random scenes, side by side.
SCENES = 40
#: Vehicles in each of them.
VEHICLES = 20
#: Decisions of every driver, one after the other: 24 s.
DECISIONS = 60

# Proximal policy optimisation.
#: Discount per decision.
GAMMA = 0.93
#: Discount of later errors in the advantages' estimate (Schulman et al. 2016).
LAMBDA = 0.9
#: Passes over an iteration's decisions.
PASSES = 2
#: Decisions of an update.
BATCH = 4096
#: How far from 1 a gain counts in the ratio of a new chance to the old one.
RATIO = 0.2
#: The highest learning rate of the policy, and that of the critic.
RATE = 3e-4
CRITIC_RATE = 1e-3
#: Drivers draw from distributions that are somewhat sharper than fitted.
TEMPERATURE = 0.8

# What keeps lane changes as recorded.
#: Weight of their rate.
RATE_PULL = 0.1
#: Weight of the divergence of lane choices.
LANE_PULL = 5.0
#: Bands of speed in each of which the rate is kept, m/s.
BANDS_MPS = ((0.0, 9.0), (9.0, 16.0), (16.0, 40.0))

# Strangers.
#: Share of the scenes that have some.
WITH_STRANGERS = 0.6
#: Share of strangers among the vehicles of these scenes.
STRANGERS = 0.12
#: Share of their decisions in which they want another lane.
PUSHING = 0.05
#: They take it where nobody has to brake harder than this, m/s2.
PUSHING_BRAKING = 5.0
#: And where this much room is left, m.
PUSHING_ROOM_M = 1.0
#: Time in which a stranger takes its speed, s.
STRANGER_S = 2.0
#: Time in which it takes its lane, s.
PUSHING_S = 1.2
#: Its lateral speed at most, m/s.
PUSHING_MPS = 1.2
#: Its strongest acceleration, m/s2.
STRANGER_ACCELERATION = 1.5
#: A desired speed with which IDM brakes for others alone, m/s: strangers have a pace of their own.
NO_LIMIT_MPS = 60.0


class Strangers(NamedTuple):
    """Whom the policy does not drive, [N, M].

    Attributes:
        there: which vehicles.
        pace: the speed that they keep or take, m/s.
        braking: at most, to take it, m/s2; they brake harder only behind others.
    """

    there: Tensor
    pace: Tensor
    braking: Tensor

    def choices(self, choice: LaneChoice, wish: Tensor, side: Tensor) -> Tensor:
        """Their lane choices [N, M], as :func:`with_choice` takes them: 1 to the left, 2 to the
        right, 0 to go on.

        Args:
            choice: what every driver could do.
            wish: uniform numbers [N, M]; small ones ask for another lane.
            side: uniform numbers [N, M]; to the left below one half, to the right above.
        """
        # On the left and on the right, [N, M, 2].
        room = leaves_room(choice.sides, PUSHING_ROOM_M, PUSHING_BRAKING) & choice.exists
        to_left = side < 0.5
        can = torch.where(to_left, room[..., 0], room[..., 1])

        # Nobody begins a second change before the first one has ended.
        pushes_in = (wish < PUSHING) & can & choice.keeping
        to_side = torch.where(to_left, 1, 2)
        return torch.where(pushes_in, to_side, 0)

    def moves(self, vehicles: Vehicles, road: Road) -> tuple[Tensor, Tensor]:
        """Accelerations, m/s2, and lateral speeds, m/s, [N, M]: IDM behind others, at their own
        pace.

        Args:
            vehicles: all of them, [N, M].
            road: that they are on.
        """
        unlimited = vehicles.with_(desired_speed=torch.full_like(self.pace, NO_LIMIT_MPS))
        behind = following_acceleration(scene_of(unlimited, road), TABLE_V)

        # To their pace, but no faster than the ones ahead allow.
        to_pace = (self.pace - vehicles.speed) / STRANGER_S
        to_pace = torch.maximum(to_pace, -self.braking)
        acceleration = torch.minimum(behind, to_pace)
        acceleration = acceleration.clamp(HARDEST_BRAKING, STRANGER_ACCELERATION)
        # At most to a stop.
        acceleration = torch.maximum(acceleration, -vehicles.speed / DECISION_S)

        # To the centre of their target lane.
        target = road.centre_of(vehicles.target_lane, vehicles.y.dtype)
        aside = (target - vehicles.y) / PUSHING_S
        return acceleration, aside.clamp(-PUSHING_MPS, PUSHING_MPS)


class Decisions(NamedTuple):
    """Decisions of all drivers, [T, N, M, ...]: what they saw, did, and what it cost.

    Attributes:
        features: of the next move, [..., FEATURES].
        sides, exists, keeping, to_left: the lane choice, as in
            :class:`~ganlane.generator.human.LaneChoice`.
        speed: m/s.
        actions: tokens along and across, lane choice, [..., 3].
        log_chance: logarithm of their probability when they were drawn.
        value: the critic's estimate of the return; a reward is a cost with its sign changed.
        cost: of the decision.
        valid: whether the decision counts; strangers' do not.
        goes_on: whether the driver is still there at the next one.
    """

    features: Tensor
    sides: Tensor
    exists: Tensor
    keeping: Tensor
    to_left: Tensor
    speed: Tensor
    actions: Tensor
    log_chance: Tensor
    value: Tensor
    cost: Tensor
    valid: Tensor
    goes_on: Tensor

    @property
    def choice(self) -> LaneChoice:
        """The lane choice that each driver had."""
        return LaneChoice(self.sides, self.exists, self.keeping, self.to_left)

    def rows(self, which: Tensor) -> Decisions:
        """Those of an index or a mask."""
        return Decisions(*(number[which] for number in self))


def tune(
    policy: HumanPolicy,
    teacher: Choices | None,
    danger: Tensor,
    iterations: int,
    pull: float,
    random: torch.Generator,
    report: Report,
) -> LaneChoice | None:
    """Fine-tune ``policy`` in place; the mean cost of a decision in each iteration is reported.

    Args:
        policy: cloned; what it is now is what it is pulled to.
        teacher: recorded lane choices, to whose rate it is pulled, too; None: to its own alone.
        danger: sides to which nobody changes, [D, SIDE_FEATURES].
        iterations: of driving and learning.
        pull: weight of the divergence from what it is now.
        random: draws scenes, moves and batches.
        report: called with the cost after every iteration.

    Returns:
        The lane choices [K] that drivers in their lanes had in the last iteration, if any.
    """
    driven = None
    reference = deepcopy(policy).requires_grad_(False)

    # The critic sees what both of the policy's networks see. It is of no use afterwards.
    critic = layers(FEATURES + 2 * SIDE_FEATURES, 64, 64, 1)
    optimizer = torch.optim.Adam(
        [
            {"params": policy.parameters(), "lr": RATE},
            {"params": critic.parameters(), "lr": CRITIC_RATE},
        ]
    )

    # Recordings without a lane change say nothing about their rate.
    recorded = 0.0
    if teacher is not None:
        recorded = begins_per_decision(teacher)

    for number in range(iterations):
        # A warm-up of five iterations, then linearly down to a fifth.
        rise = min(1.0, (number + 1) / 5)
        fall = 1.0 - 0.8 * number / iterations
        optimizer.param_groups[0]["lr"] = RATE * rise * fall

        # The policy's decisions, [T, N, M, ...], and what they were worth.
        decisions = drive(policy, critic, random)
        advantage, wanted = advantages(decisions)

        # Those that count, one below the other: [R, ...].
        counts = decisions.valid
        flat = decisions.rows(counts)
        driven = flat.rows(flat.keeping).choice
        wanted = wanted[counts]
        advantage = advantage[counts]
        # In units of their own spread, so that the step does not depend on the costs' scale.
        advantage = (advantage - advantage.mean()) / (advantage.std() + 0.01)

        for _ in range(PASSES):
            for rows in torch.randperm(len(wanted), generator=random).split(BATCH):
                part = flat.rows(rows)
                loss = _policy_loss(policy, reference, part, advantage[rows], pull)

                # The critic learns the returns; its weights are none of the policy's.
                values = _values(critic, part.features, part.sides)
                loss = loss + smooth_l1_loss(values, wanted[rows])

                if teacher is not None and recorded > 0.0:
                    off = _rate_loss(policy, part, teacher, recorded, random)
                    loss = loss + RATE_PULL * off

                # Nobody begins a change into danger, and who is in one breaks it off.
                # The logit to begin one is to be below -10, that to break it off above 0.
                rows_of_danger = torch.randint(len(danger), (512,), generator=random)
                to_begin, to_stop = policy.lane(danger[rows_of_danger]).unbind(-1)
                loss = loss + RATE_PULL * softplus(to_begin + 10.0).mean()
                loss = loss + 0.2 * RATE_PULL * softplus(-to_stop).mean()

                descend(optimizer, loss, 1.0)

        report(float(decisions.cost.sum()) / float(counts.sum()))
    return driven


def begins_per_decision(teacher: Choices) -> float:
    """Lane changes begun per recorded decision of a driver in its lane."""
    begun = (teacher.begins == 1).sum()
    return float(begun) / max(1, len(teacher.keeping_sides))


def _values(critic: nn.Module, features: Tensor, sides: Tensor) -> Tensor:
    """The critic's values [...] of features [..., FEATURES] and sides [..., 2, SIDE_FEATURES]."""
    inputs = torch.cat((features, sides.flatten(-2)), -1)
    return critic(inputs)[..., 0]


def advantages(decisions: Decisions) -> tuple[Tensor, Tensor]:
    """Advantages, and values for the critic to learn, [T, N, M].

    Generalised advantage estimation (Schulman et al. 2016, equation 16). An advantage is by how
    much the rewards that followed a decision were better than the critic had expected; the value to
    learn is this expectation and the advantage together.
    """
    reward = -decisions.cost
    value = decisions.value
    advantage = torch.zeros_like(reward)

    # The last decision is taken to be followed by one of its own value.
    following = value[-1]
    last = torch.zeros_like(following)

    # Backwards in time: an advantage holds the errors that follow, discounted.
    for step in reversed(range(len(reward))):
        goes_on = decisions.goes_on[step].to(reward.dtype)
        # The error of temporal differences: nothing follows where the driver is gone.
        error = reward[step] + GAMMA * goes_on * following - value[step]
        last = error + GAMMA * LAMBDA * goes_on * last
        advantage[step] = last
        following = value[step]
    return advantage, advantage + value


def _log_chances(policy: HumanPolicy, features: Tensor, choice: LaneChoice) -> tuple[Tensor, ...]:
    """Logarithms of the chances of all tokens along [..., 41] and across [..., 31], and of all lane
    choices [..., 3].
    """
    # The lane choice has no temperature: its rate is fitted as it is.
    along, across = policy(features)
    return (
        torch.log_softmax(along / TEMPERATURE, -1),
        torch.log_softmax(across / TEMPERATURE, -1),
        policy.lane_chances(choice).log(),
    )


def _of_actions(chances: tuple[Tensor, ...], actions: Tensor) -> Tensor:
    """Logarithm of the chance of what was done, [...].

    Args:
        chances: of :func:`_log_chances`.
        actions: tokens along and across, lane choice, [..., 3].
    """
    taken = []
    for log_chances, action in zip(chances, actions.unbind(-1)):
        of_action = log_chances.gather(-1, action[..., None])
        taken.append(of_action[..., 0])
    # A product of chances: both tokens are drawn after the lane choice, each for itself.
    return torch.stack(taken).sum(0)


def _policy_loss(
    policy: HumanPolicy,
    reference: HumanPolicy,
    decisions: Decisions,
    advantage: Tensor,
    pull: float,
) -> Tensor:
    """The clipped objective (Schulman et al. 2017, equation 7), and the divergence from the
    reference.

    Args:
        policy: the one that learns.
        reference: what it was before the fine-tuning.
        decisions: B of them, [B, ...].
        advantage: theirs, [B].
        pull: weight of the divergence.
    """
    log_chances = _log_chances(policy, decisions.features, decisions.choice)
    log_chance = _of_actions(log_chances, decisions.actions)

    # By how much likelier the actions are now than when they were drawn.
    ratio = torch.exp((log_chance - decisions.log_chance).clamp(-5.0, 5.0))
    bounded_ratio = ratio.clamp(1.0 - RATIO, 1.0 + RATIO)
    gain = torch.minimum(ratio * advantage, bounded_ratio * advantage).mean()

    # Kullback-Leibler divergences along, across and of the lane choice.
    with torch.no_grad():
        of_reference = _log_chances(reference, decisions.features, decisions.choice)
    divergences = []
    for now, before in zip(log_chances, of_reference):
        apart = now.exp() * (now - before)
        divergences.append(apart.sum(-1).mean())
    along, across, lane = divergences
    return -gain + pull * (along + across) + LANE_PULL * lane


def _rate_loss(
    policy: HumanPolicy,
    decisions: Decisions,
    teacher: Choices,
    recorded: float,
    random: torch.Generator,
) -> Tensor:
    """How far lane changes are from the ``recorded`` rate per decision: at all speeds in
    simulation, and in recorded states. Squares of the logarithm of the ratio.

    Args:
        policy: whose rate it is.
        decisions: B of them in simulation, [B, ...].
        teacher: recorded lane choices.
        recorded: lane changes begun per decision, above 0.
        random: draws among the recorded states.
    """
    # Whoever is in its lane: the chance to begin a change to the left or to the right.
    _, left, right = policy.lane_chances(decisions.choice).unbind(-1)
    begins = left + right

    # In simulation, at low, middle and high speeds alike.
    loss = torch.zeros(())
    for low, high in BANDS_MPS:
        in_band = (decisions.speed >= low) & (decisions.speed < high)
        here = in_band & decisions.keeping
        # A rate of fewer decisions says little.
        if int(here.sum()) > 200:
            ratio = begins[here].mean() / recorded
            loss = loss + torch.log(ratio).square() / len(BANDS_MPS)

    # In recorded states, over all speeds.
    rows = torch.randint(len(teacher.keeping_sides), (8192,), generator=random)
    _, left, right = policy.lane_chances(teacher.keeping(rows)).unbind(-1)
    ratio = (left + right).mean() / recorded
    return loss + torch.log(ratio).square()


@torch.no_grad()
def drive(policy: HumanPolicy, critic: nn.Module, random: torch.Generator) -> Decisions:
    """Decisions [T, N, M] of :data:`DECISIONS` steps in random scenes.

    Args:
        policy: drives everybody but the strangers.
        critic: estimates what the returns will be.
        random: draws scenes and moves.
    """
    vehicles, memory, road, strangers = random_scenes(random)
    rand, _ = draws(vehicles.x.shape, random)

    steps: list[Decisions] = []
    for _ in range(DECISIONS):
        # Lane choices: the policy's, and the strangers' own.
        situation = situation_of(vehicles, memory, road)
        choice = lane_choice(situation)
        lane = _drawn(policy.lane_chances(choice), random)
        strangers_lane = strangers.choices(choice, wish=rand(), side=rand())
        lane = torch.where(strangers.there, strangers_lane, lane)
        situation = with_choice(situation, lane)
        vehicles = situation.vehicles
        view = situation.view

        # The moves follow the choice: a token, and a place within it that nobody learns from.
        features = features_of(situation)
        tokens = []
        changes = []
        for axis, logits in zip((ALONG, ACROSS), policy(features)):
            chances = torch.softmax(logits / TEMPERATURE, -1)
            token = _drawn(chances, random)
            tokens.append(token)
            within = rand() - 0.5
            changes.append(axis.value(token + within))
        acceleration, aside = bounded(situation, *changes)

        strangers_acceleration, strangers_aside = strangers.moves(vehicles, road)
        acceleration = torch.where(strangers.there, strangers_acceleration, acceleration)
        aside = torch.where(strangers.there, strangers_aside, aside)

        # A decision later.
        memory = remembered(situation, acceleration)
        later = moved(vehicles, acceleration, aside)
        cost, hit = costs(later, road, view.gap)
        # Who has collided leaves the scene.
        goes_on = vehicles.valid & ~hit

        actions = torch.stack((*tokens, lane), -1)
        log_chances = _log_chances(policy, features, choice)
        decisions = Decisions(
            features=features,
            **choice._asdict(),
            speed=view.speed,
            actions=actions,
            log_chance=_of_actions(log_chances, actions),
            value=_values(critic, features, choice.sides),
            cost=cost,
            valid=vehicles.valid & ~strangers.there,
            goes_on=goes_on,
        )
        steps.append(decisions)
        vehicles = later.with_(valid=goes_on)

    # Every field of all steps, one after the other: [T, N, M, ...].
    return Decisions(*map(torch.stack, zip(*steps)))


def _drawn(chances: Tensor, random: torch.Generator) -> Tensor:
    """Numbers [N, M] below K, drawn by their ``chances`` [N, M, K]."""
    # multinomial takes rows [N * M, K].
    drawn = torch.multinomial(chances.flatten(0, 1), 1, generator=random)
    return drawn.view(chances.shape[:-1])


def costs(vehicles: Vehicles, road: Road, gap: Tensor) -> tuple[Tensor, Tensor]:
    """Cost of every driver after a decision, and who has collided, [N, M].

    An accident costs everybody in it 1, and 5 more who is to blame; being beyond the edge of the
    road costs 3 and more. Close calls, and standing or driving slowly without need, cost some
    tenths.

    Args:
        vehicles: after the decision, [N, M].
        road: that they are on.
        gap: to the leader before the decision, m, [N, M].
    """
    speed, lateral = velocity(vehicles)

    # Pairs [N, M, M]: the last index is the other vehicle.
    # Gaps of their bodies along the road and across it are below 0 where they overlap, m.
    along, bumpers, order = compare(vehicles, road)
    across = vehicles.y[:, None] - vehicles.y[..., None]
    mean_width = 0.5 * (vehicles.width[:, None] + vehicles.width[..., None])
    sides = across.abs() - mean_width

    # Nobody is a pair with itself.
    both = vehicles.valid[..., None] & vehicles.valid[:, None] & (order != 0)

    # Accidents. Bodies count as touching a little before they do.
    touches = both & (bumpers < 0.2) & (sides < 0.05)
    # To blame are the one behind, and the one who moves, or has moved, towards the other.
    towards = torch.sign(across)
    off_target = vehicles.y - road.centre_of(vehicles.target_lane, lateral.dtype)
    moves_aside = lateral[..., None] * towards > 0.15
    has_moved_aside = off_target[..., None] * towards > 0.6
    sideways = moves_aside | has_moved_aside
    # Behind the other, and not just beside it: the bodies overlap by more than 0.4 m across.
    behind = (along > 0) & (sides < -0.4)
    blame = touches & (sideways | behind)
    hit = touches.any(-1)
    cost = 5.0 * blame.any(-1) + hit

    # Close calls ahead: a time to collision below 1.5 s, a gap below 0.25 s; 99 is none, s or m.
    closing = speed[..., None] - speed[:, None]
    ahead = both & (along > 0) & (sides < 0.15) & (bumpers > 0)
    time_s = bumpers / closing.clamp_min(0.1)
    time_s = torch.where(ahead & (closing > 0.1), time_s, 99.0).amin(-1)
    nearest = torch.where(ahead, bumpers, 99.0).amin(-1)
    headway_s = nearest / speed.clamp_min(2.0)
    too_late = (1.5 - time_s).clamp_min(0.0)
    too_close = (0.25 - headway_s).clamp_min(0.0)
    cost = cost + 0.15 * (too_late + 2.0 * too_close)

    # Close calls beside: sides within 0.35 m of who moves towards the other.
    beside = both & (bumpers < 0.5) & (sides < 0.35) & (sides >= 0.05) & sideways
    cost = cost + 0.15 * beside.any(-1)

    # The edges of the road, for the turned body: by how much it is beyond one, m, and 0.25 m early.
    # The lateral speed over the speed along the road is the tangent of the heading.
    turned = (lateral.abs() / speed.clamp_min(2.0)).clamp_max(0.3)
    half = 0.5 * vehicles.width + 0.5 * vehicles.length * turned
    beyond_right = road.right_edge_m() - (vehicles.y - half)
    beyond_left = vehicles.y + half - road.left_edge_m()
    beyond = torch.maximum(beyond_right, beyond_left)
    cost = cost + 3.0 * (beyond > 0) + (beyond + 0.25).clamp(0.0, 1.0)

    # Nobody stands or crawls where the road is free.
    crawls = (speed < 3.0) & (gap > 40.0)
    cost = cost + 0.3 * crawls
    # Nobody is slower than three quarters of its wish there.
    slow = (0.75 - speed / vehicles.desired_speed).clamp(0.0, 0.5)
    cost = cost + 0.05 * slow * (gap > 80.0)
    return cost * vehicles.valid, hit & vehicles.valid


def random_scenes(random: torch.Generator) -> tuple[Vehicles, Memory, Road, Strangers]:
    """Scenes of 2 to 5 lanes, 3 to 28 m/s, people's headways, dense and sparse; in some of them
    some of the vehicles are strangers.

    Returns:
        Vehicles and memories [N, M], one road per scene, and the strangers among the vehicles.
    """
    # Numbers of vehicles [N, M] and of scenes [N, 1]; the order of the draws is part of a fit.
    shape = (SCENES, VEHICLES)
    rand, randn = draws(shape, random)
    rand_of_scene, _ = draws((SCENES, 1), random)

    # Four in ten scenes have three lanes, the others 2 to 5; lanes are 3.3 to 4.1 m wide.
    lanes = torch.randint(2, 6, (SCENES, 1), generator=random).float()
    lanes = torch.where(rand_of_scene() < 0.4, 3.0, lanes)
    road = Road(lanes, lane_width_m=3.3 + 0.8 * rand_of_scene())
    lane = (rand() * lanes).floor()

    # Speeds, m/s: of the scene, of the lane, of the vehicle.
    of_scene = 3.0 + 25.0 * rand_of_scene()
    of_lane = of_scene + 1.5 * randn(SCENES, 6)
    speed = of_lane.gather(1, lane.long()) + 0.8 * randn()
    speed = speed.clamp(0.5, 34.0)

    # In half of the scenes, headways are up to five times as long as in dense traffic.
    sparse = torch.where(rand_of_scene() < 0.5, 1.0, 1.0 + 4.0 * rand_of_scene())
    # Six vehicles in a hundred are lorries.
    length = torch.where(rand() < 0.06, 12.0, 4.2 + 0.8 * rand())

    # From the front of one vehicle to that of the next, m. Headways are log-normal about 1.3 s.
    headway_s = torch.exp(math.log(1.3) + 0.45 * randn()).clamp(0.6, 5.0)
    space = headway_s * sparse * speed + 3.0 + length

    # Fronts, m: one behind another in each lane.
    zero = torch.zeros(shape)
    front = zero
    for number in range(5):
        here = lane == number
        behind = -(space * here).cumsum(1) - 30.0 * rand_of_scene()
        front = torch.where(here, behind, front)

    # In half of the scenes the present speed and up to 10 m/s more, in the others 18 to 26 m/s.
    as_they_drive = rand_of_scene() < 0.5
    faster = speed + 10.0 * rand()
    wish = 18.0 + 8.0 * rand()
    desired = torch.where(as_they_drive, faster, wish)

    # Drivers are up to half a metre from the centre of their lane.
    off_centre = 0.25 * randn().clamp(-2.0, 2.0)
    vehicles = cars(
        front - 0.5 * length,
        lane * road.lane_width_m + off_centre,
        speed,
        zero,
        acceleration=zero,
        length=length,
        width=zero + 1.9,
        desired_speed=desired.clamp(*DESIRED_MPS),
        target_lane=lane.long(),
    )
    memory = entering_memory(vehicles, road, drawn=randn())

    # Half of the strangers are slow, some brake hard.
    there = (rand() < STRANGERS) & (rand_of_scene() < WITH_STRANGERS)
    is_slow = rand() < 0.5
    slow = 8.0 * rand()
    usual = 8.0 + 20.0 * rand()
    strangers = Strangers(
        there,
        pace=torch.where(is_slow, slow, usual),
        braking=1.0 + 4.0 * rand(),
    )
    return vehicles, memory, road, strangers


def entering_memory(vehicles: Vehicles, road: Road, drawn: Tensor) -> Memory:
    """The memory of drivers who have always driven as they do now.

    Who follows somebody keeps the present headway; the others' are drawn: 1.4 s in the middle,
    spread by a third.

    Args:
        vehicles: [N, M].
        road: that they are on.
        drawn: standard normal numbers [N, M].
    """
    view = perceive(vehicles, road)

    # Neither accelerations nor changes of the lateral speed so far.
    steady = vehicles.x.new_zeros(*vehicles.x.shape, ACCELERATIONS)
    lateral_speeds = torch.stack((view.aside, view.aside), -1)
    memory = memory_of(steady, lateral_speeds, torch.zeros_like(vehicles.x))

    # As if everybody had a leader, so that the style begins with a headway of the driver's own.
    free = view.log_headway.isnan()
    log_headway = torch.where(free, math.log(1.4) + 0.35 * drawn, view.log_headway)
    view = view._replace(log_headway=log_headway)
    return with_style(memory, view, first=torch.ones_like(vehicles.valid))
