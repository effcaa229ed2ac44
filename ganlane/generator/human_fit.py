"""The fit of ``human``: cloning, then samples in closed loop; fine-tuning follows it.

Cloning alone drifts, since a clone never sees its own mistakes. So the policy drives the recorded
scenes itself: of several moves that it draws, the nearest to the recording is made, and the target
is what leads back to it. Where recordings are silent (fast, free, standing, about to collide, off
the lane) samples of drivers with headways of their own stand in, who follow a simple law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from ganlane.data.dense import Recording
from ganlane.generator.descent import descend, half_cosine
from ganlane.generator.human import (
    ACCELERATIONS,
    ACROSS,
    ALONG,
    SAME,
    HumanPolicy,
    LaneChoice,
    Memory,
    Situation,
    cars,
    features_of,
    lane_choice,
    leaves_room,
    perceive,
)
from ganlane.generator.human_estimator import HumanModel, fit_estimator
from ganlane.generator.human_samples import (
    DESIRED_MPS,
    Choices,
    Cut,
    Moves,
    Options,
    Samples,
    SmoothScene,
    cuts,
    draws,
    joined,
    samples_of,
    smooth_scene,
    without_noise,
)
from ganlane.generator.human_tuning import NO_LIMIT_MPS, Report, begins_per_decision, tune
from ganlane.settings.generator import HumanConfig
from ganlane.sim.idm import IdmParameters, following_acceleration
from ganlane.sim.neighbours import perceive as scene_of
from ganlane.sim.state import Road, Vehicles

# What is fitted to.
#: Decisions of a stretch of a scene.
LONG_DECISIONS = 20
#: Decisions of a short one; these begin more often as recorded.
SHORT_DECISIONS = 5
#: Weight of samples from files of one lane.
ONE_LANE_WEIGHT = 0.5
#: Random scenes of the prior.
PRIOR_SCENES = 9000
#: Vehicles in each of them.
PRIOR_VEHICLES = 8

#: Above this speed, m/s, recordings that were sped up are silent, too.
FASTEST_MPS = 30.0
# How drivers of the prior follow. On US-101 the acceleration over the next two seconds is 0.41,
# 0.23 and 0.06 times the speed difference, at gaps around 5, 20 and 55 m
# (python -m benchmarks.human_fits responses).
#: The response to a speed difference is this by the gap, m/s, and at most that, 1/s.
CLOSING_GAIN_MPS = 4.5
LARGEST_CLOSING_GAIN = 0.4
#: Response to the logarithm of the gap over the wanted one, m/s2.
HEADWAY_GAIN = 0.1
#: Response to what a driver is slower than it wishes, 1/s.
FREE_GAIN = 0.12
#: They brake as these IDM drivers, with a short headway, where a leader gets close.
CLOSE_IDM = IdmParameters(
    headway_s=0.3,
    comfortable_deceleration=2.0,
    min_acceleration=-8.0,
    max_acceleration=1.4,
)

# The moves.
#: Samples of an update.
BATCH = 1024
#: Samples of the prior beside them, per sample.
PRIOR_SHARE = 0.15
#: Noise on the inputs, so that the policy does not hang on their last digits.
INPUT_NOISE = 0.02

# The lane choice: lane changes are few.
#: How many updates there are.
LANE_UPDATES = 300
#: Their learning rate.
LANE_RATE = 3e-3
#: Decay of the weights.
LANE_DECAY = 0.05

#: How often the level of lane changes is set, with a fine-tuning after it.
SETTLINGS = 2
#: How much more strongly the policy is pulled to what it is in these.
SETTLING_TIMES = 2.0


def fit_steps(config: HumanConfig) -> int:
    """Steps of a fit: cloning, rounds in closed loop, and the iterations of all fine-tunings."""
    return 1 + config.rounds + config.tuning + SETTLINGS * config.settling


class Material(NamedTuple):
    """What a policy is fitted to: stretches of recordings, and the prior's samples.

    Attributes:
        around: stretches of two-dimensional scenes, in which drivers see their sides.
        ahead: stretches of one lane.
        short: short stretches of both.
        prior: moves where recordings are silent.
        danger: sides to which a lane change leaves no room, [D, SIDE_FEATURES].
    """

    around: list[Cut]
    ahead: list[Cut]
    short: list[Cut]
    prior: Moves
    danger: Tensor


def material_of(scenes: Sequence[SmoothScene], random: torch.Generator) -> Material:
    """Everything that a policy is fitted to.

    Stretches overlap: they begin every few frames of 0.1 s, more often where scenes are few.

    Args:
        scenes: smoothed ones, of several lanes and of one.
        random: draws the prior.
    """
    wide = [scene for scene in scenes if scene.two_dimensional]
    narrow = [scene for scene in scenes if not scene.two_dimensional]
    short_wide = cuts(wide, SHORT_DECISIONS, stride=4)
    short_narrow = cuts(narrow, SHORT_DECISIONS, stride=40)

    prior, danger = prior_samples(random)
    return Material(
        around=cuts(wide, LONG_DECISIONS, stride=10),
        ahead=cuts(narrow, LONG_DECISIONS, stride=60),
        short=short_wide + short_narrow,
        prior=prior,
        danger=danger,
    )


def fit_human(
    config: HumanConfig,
    recordings: Sequence[Recording],
    following: Sequence[Recording] = (),
    report: Report = lambda cost: None,
) -> HumanModel:
    """Fit a model to ``recordings`` of several lanes and to cars ``following`` each other in one.

    Args:
        config: sizes, seed, learning rate and the number of epochs, rounds and iterations.
        recordings: positions along and across the road, 10 Hz, m.
        following: positions along the road alone; they weigh :data:`ONE_LANE_WEIGHT`.
        report: called after each of the :func:`fit_steps`.

    Returns:
        The model in evaluation mode, without gradients. Its observer is not fitted yet
        (:func:`ganlane.generator.human_forecasts.fit_observer`).
    """
    # Networks draw their first weights from torch's own generator, which stays the caller's.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        random = torch.Generator().manual_seed(config.seed)
        model = HumanModel(config.sizes)

        # The estimator learns from recorded noise, and to leave exact positions as they are.
        scenes = [smooth_scene(recording, config) for recording in recordings]
        exact = [without_noise(recording, config) for recording in recordings]
        fit_estimator(model.estimator, [*scenes, *exact], config.faster_mps, random)

        # Files of one lane show no motion across the road, so the estimator does without them.
        scenes += [smooth_scene(one, config, ONE_LANE_WEIGHT) for one in following]
        material = material_of(scenes, random)

        # Lane changes are few: none of them is hidden, as the sides are from some of the moves.
        choices = _gathered(material, Options(blind=0.0), config, random, times=2).choices
        teacher = _gathered(material, Options(), config, random, times=3).moves

        # Cloning: the first half of the epochs at the full rate, the second at half of it.
        policy = model.policy
        danger = material.danger
        epochs = max(1, config.epochs // 2)
        for rate in (config.learning_rate, 0.5 * config.learning_rate):
            train_moves(policy, teacher, material.prior, epochs, rate, random)
        train_lane_choice(policy, choices, danger, random)
        match_rate(policy, choices)
        report(None)

        close_the_loop(model, material, teacher, config, random, report)

        # Accidents cost; the pull keeps the rest as it is.
        driven = tune(policy, choices, danger, config.tuning, config.pull, random, report)

        # More lane changes bring new accidents: it learns to do without them at this level.
        pull = SETTLING_TIMES * config.pull
        for _ in range(SETTLINGS):
            match_rate(policy, choices, driven)
            driven = tune(policy, None, danger, config.settling, pull, random, report)
        return model.eval().requires_grad_(False)


def close_the_loop(
    model: HumanModel,
    material: Material,
    teacher: Moves,
    config: HumanConfig,
    random: torch.Generator,
    report: Report,
) -> None:
    """Fit the policy of ``model`` to where its own moves lead, in ``config.rounds`` rounds.

    A round is fitted to its own closed-loop samples, to those of the round before, and to as many
    samples of the ``teacher``, in which everybody drives as recorded.

    Args:
        model: with a cloned policy and a fitted estimator.
        material: whose stretches the policy drives.
        teacher: moves as recorded.
        config: rounds, epochs, learning rate, and moves drawn per decision.
        random: draws moves, and the order of samples.
        report: called after every round.
    """
    bank: list[Moves] = []
    options = Options(model.policy, samples=config.samples)
    noisy = options._replace(estimator=model.estimator)
    epochs = max(1, config.epochs // 3)

    for number in range(config.rounds):
        # Long stretches begin as recorded, short ones as nine noisy positions show drivers.
        long = _gathered(material, options, config, random, times=2)
        short = samples_of(material.short, noisy, random)
        latest = joined([long, short]).moves
        bank = [*bank[-1:], latest]

        # As many samples of the teacher as of this round, drawn anew.
        order = torch.randperm(len(teacher.change), generator=random)
        as_recorded = teacher.rows(order[: len(latest.change)])
        moves = Moves(*map(torch.cat, zip(as_recorded, *bank)))

        # From half of the cloning's rate down to a sixth of it.
        done = number / max(1, config.rounds - 1)
        rate = 0.5 * config.learning_rate * (1.0 - 0.7 * done)
        train_moves(model.policy, moves, material.prior, epochs, rate, random)
        report(None)


def _gathered(
    material: Material,
    options: Options,
    config: HumanConfig,
    random: torch.Generator,
    times: int,
) -> Samples:
    """Samples of all stretches: of scenes several times, of single lanes once.

    Passes differ by what is drawn: sides swapped or hidden, lanes widened, moves of the policy. In
    the last pass everybody is faster by up to ``config.faster_mps``.

    Args:
        material: with the stretches.
        options: who drives, and what is varied.
        config: by how much everybody is faster.
        random: draws what differs.
        times: passes over the scenes.
    """
    parts = []
    for faster_mps in [0.0] * (times - 1) + [config.faster_mps]:
        sped_up = options._replace(faster_mps=faster_mps)
        parts.append(samples_of(material.around, sped_up, random))

    if material.ahead:
        # Cars of one lane have no sides to be hidden, and nothing to be mirrored.
        alone = options._replace(vary=False, blind=0.0)
        parts.append(samples_of(material.ahead, alone, random))
    return joined(parts)


def train_moves(
    policy: HumanPolicy,
    moves: Moves,
    prior: Moves,
    epochs: int,
    rate: float,
    random: torch.Generator,
) -> None:
    """Fit the distributions to ``moves``, with the prior's beside them.

    The loss is the cross-entropy of the tokens around the wanted changes along and across
    (:meth:`ganlane.generator.human.Tokens.soft_target`), weighted per sample.

    Args:
        moves: batches hold :data:`BATCH` of these samples.
        prior: a batch holds :data:`PRIOR_SHARE` as many of these besides, drawn at random.
        epochs: passes over ``moves``.
        rate: the highest learning rate.
        random: draws batches, and noise on their inputs.
    """
    # The lane choice has a network of its own, which stays as it is.
    fitted = nn.ModuleList([policy.trunk, policy.along, policy.across])
    optimizer = torch.optim.AdamW(fitted.parameters(), lr=rate, weight_decay=1e-3, fused=True)

    rows = len(moves.change)
    updates = max(1, epochs * (rows // BATCH))
    update = 0
    for _ in range(epochs):
        for batch in torch.randperm(rows, generator=random).split(BATCH):
            # The batch [B], and beside it [P] of the prior's samples.
            beside = int(PRIOR_SHARE * len(batch))
            of_prior = torch.randint(len(prior.change), (beside,), generator=random)
            pairs = zip(moves.rows(batch), prior.rows(of_prior))
            both = Moves(*map(torch.cat, pairs))

            # Logits [B + P, tokens] of what is seen with a little noise.
            noise = INPUT_NOISE * torch.randn(both.features.shape, generator=random)
            along, across = policy(both.features + noise)

            # Cross-entropies [B + P].
            wanted_along = ALONG.soft_target(both.change)
            wanted_across = ACROSS.soft_target(both.aside)
            loss_along = -(wanted_along * along.log_softmax(-1)).sum(-1)
            loss_across = -(wanted_across * across.log_softmax(-1)).sum(-1)
            weighted = loss_along * both.weight + loss_across * both.lateral_weight
            loss = weighted.mean()

            # A short warm-up, then a half cosine to 0.
            rise = min(1.0, (update + 1) / 100)
            optimizer.param_groups[0]["lr"] = rate * (rise * half_cosine(update, updates))
            descend(optimizer, loss, 5.0)
            update += 1


def train_lane_choice(
    policy: HumanPolicy,
    choices: Choices,
    danger: Tensor,
    random: torch.Generator,
) -> None:
    """Fit when a lane change begins, and when one is broken off.

    Beginning is a logistic regression on the recorded ones; nobody begins one into danger. Changes
    under way go on as recorded ones did, and are broken off in danger.

    Args:
        policy: its network ``lane`` has two logits per side: to begin a change, to break it off.
        choices: recorded ones; without a recorded change the policy stays as it is.
        danger: sides that nobody changes to, [D, SIDE_FEATURES].
        random: draws batches.
    """
    # Sides [S, SIDE_FEATURES] of three kinds.
    begun = choices.sides[choices.begins == 1]
    not_begun = choices.sides[choices.begins == 0]
    under_way = choices.sides[choices.begins < 0]
    if not len(begun):
        return

    # Begin from the recorded rate, with little influence of what is seen.
    log_odds = math.log(len(begun) / len(not_begun))
    weight, bias = policy.lane[-1].parameters()
    with torch.no_grad():
        bias.copy_(torch.tensor([log_odds, -2.0]))
        weight.mul_(0.1)

    optimizer = torch.optim.AdamW(policy.lane.parameters(), lr=LANE_RATE, weight_decay=LANE_DECAY)
    for _ in range(LANE_UPDATES):
        # All of the few recorded changes, and some of the many decisions against one.
        rows = torch.randint(len(not_begun), (4096,), generator=random)
        others = torch.randint(len(danger), (1024,), generator=random)
        begins = policy.lane(begun)[:, 0]
        stays = policy.lane(not_begun[rows])[:, 0]

        # The negative log-likelihood, per recorded change, so that few count as much as many. The
        # drawn decisions stand for all of them.
        scale = len(not_begun) / len(rows)
        negative_log_likelihood = softplus(-begins).sum() + scale * softplus(stays).sum()
        loss = negative_log_likelihood / len(begun)

        # Into danger: begun with a logit below -10, broken off with a positive one.
        to_begin, to_stop = policy.lane(danger[others]).unbind(-1)
        loss = loss + 2.0 * softplus(to_begin + 10.0).mean()
        loss = loss + softplus(-to_stop).mean()

        # Under way as recorded: broken off with a logit below -1.
        if len(under_way):
            to_stop = policy.lane(under_way)[:, 1]
            loss = loss + 2.0 * softplus(to_stop + 1.0).mean()
        descend(optimizer, loss)


@torch.no_grad()
def match_rate(policy: HumanPolicy, choices: Choices, driven: LaneChoice | None = None) -> None:
    """Let lane changes begin as often as recorded ones did.

    That is over the recorded states and over driven ones, which count as much: where recorded
    drivers took gaps that count as danger here, no change begins, and others make up for it. Only
    the level is moved: the bias of all beginnings.

    Args:
        policy: it is changed in place.
        choices: recorded ones.
        driven: those of drivers in their lanes in a simulation (:func:`tune`), [K]; None: there are
            none yet.
    """
    wanted = begins_per_decision(choices)
    _, bias = policy.lane[-1].parameters()
    unmoved = bias[0].clone()
    of_states = [choices.keeping(slice(None))]
    if driven is not None:
        of_states.append(driven)

    # Bisection: the rate grows with the bias, which moves by -6 to 6.
    low = -6.0
    high = 6.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        bias[0] = unmoved + middle
        rates = [policy.lane_chances(choice)[:, 1:].sum(-1).mean() for choice in of_states]
        if float(sum(rates)) / len(rates) < wanted:
            low = middle
        else:
            high = middle


class PriorDrivers(NamedTuple):
    """Drivers in random scenes, [N, M] each; ``vehicles`` do not accelerate yet.

    Attributes:
        vehicles: where they are, how fast, and where they head for.
        lane: whose centre a driver swings back to, int64; it may head for another one.
        speed: along the road as drawn, m/s.
        aside: across the road as drawn, m/s.
        headway: that the driver keeps, s.
    """

    vehicles: Vehicles
    lane: Tensor
    speed: Tensor
    aside: Tensor
    headway: Tensor


def prior_drivers(road: Road, scenes: int, random: torch.Generator) -> PriorDrivers:
    """Drivers at random places on a ``road`` of three lanes, :data:`PRIOR_VEHICLES` in a scene.

    Speeds are 0 to 38 m/s, headways around 1.25 s (log-normal, 0.5 to 3 s). The drivers of a scene
    are about equally fast, at a density of its own: 60 to 560 m for all of them.

    Args:
        road: with three lanes or more.
        scenes: N, how many there are.
        random: draws the drivers.
    """
    # The order of the draws is part of a fit.
    shape = (scenes, PRIOR_VEHICLES)
    rand, randn = draws(shape, random)
    lane = torch.randint(0, 3, shape, generator=random)

    # A third of the drivers is somewhere between two lanes.
    astray = rand() < 0.35
    spread_m = torch.where(astray, 3.2, 0.5)
    y = lane * road.lane_width_m + spread_m * (rand() - 0.5)

    # The pace [N, 1] of a scene, what drivers differ from it, and a few who stand or crawl.
    pace = 36.0 * rand(scenes, 1) ** 0.8
    apart = 6.0 * randn() * rand(scenes, 1)
    speed = (pace + apart).clamp(0.0, 38.0)
    speed = torch.where(rand() < 0.08, 3.0 * rand(), speed)

    # Half of the drivers would like to go as fast as they do, or up to 8 m/s faster; the others
    # have a wish that does not depend on how fast they are.
    independent = rand() < 0.5
    wish = 14.0 + 20.0 * rand()
    desired = torch.where(independent, wish, speed + 8.0 * rand())

    headway = torch.exp(math.log(1.25) + 0.42 * randn()).clamp(0.5, 3.0)
    # Who is between two lanes moves across the road more.
    aside = torch.where(astray, 0.45, 0.15) * randn()

    zero = torch.zeros(shape)
    vehicles = cars(
        rand() * (60.0 + 500.0 * rand(scenes, 1)),
        y,
        speed,
        aside,
        acceleration=zero,
        length=zero + 4.5,
        width=zero + 1.9,
        desired_speed=desired.clamp(*DESIRED_MPS),
        target_lane=torch.where(astray, road.lane_of(y).long(), lane),
    )
    return PriorDrivers(vehicles, lane, speed, aside, headway)


def prior_acceleration(vehicles: Vehicles, road: Road, headway: Tensor) -> Tensor:
    """What drivers of the prior ask for, m/s2, [N, M].

    Behind an equally fast leader they keep the headway that their style shows. They respond to a
    speed difference as recorded drivers do, the less the larger the gap is in metres: 1.25 s
    behind a leader at 25 m/s by 0.15 m/s2 per m/s, where IDM does by 0.7. What is dangerous is left
    to IDM.

    Args:
        vehicles: fields [N, M].
        road: that they are on.
        headway: that a driver keeps, s, [N, M].
    """
    view = perceive(vehicles, road)
    speed = view.speed
    gap = view.gap.clamp_min(0.5)

    # To the leader's speed, and to the wanted gap.
    gain = (CLOSING_GAIN_MPS / gap).clamp_max(LARGEST_CLOSING_GAIN)
    wanted_gap = headway * speed.clamp_min(2.0)
    for_gap = HEADWAY_GAIN * torch.log(gap / wanted_gap).clamp(-1.0, 1.0)
    following = gain * view.closing + for_gap

    # To the desired speed, unless a leader is in the way.
    free = FREE_GAIN * (vehicles.desired_speed - speed)
    follows = view.ahead.exists[..., SAME]
    wanted = torch.where(follows, torch.minimum(following, free), free)
    wanted = wanted.clamp(-2.0, CLOSE_IDM.max_acceleration)

    # A limit on how close one comes; no desired speed holds anybody back here.
    unlimited = vehicles.with_(desired_speed=torch.full_like(speed, NO_LIMIT_MPS))
    limit = following_acceleration(scene_of(unlimited, road), CLOSE_IDM)
    return torch.minimum(wanted, limit)


@torch.no_grad()
def prior_samples(random: torch.Generator, scenes: int = PRIOR_SCENES) -> tuple[Moves, Tensor]:
    """What recordings do not show: moves of the prior's drivers, and lane changes into danger.

    Args:
        random: draws drivers, and what they have done so far.
        scenes: how many there are, of :data:`PRIOR_VEHICLES` each.

    Returns:
        Moves of the drivers [R] whose situation is rare or missing in recordings, and sides
        [D, SIDE_FEATURES] where a lane change leaves no room.
    """
    road = Road(3, 3.6)
    vehicles, lane, speed, aside, headway = prior_drivers(road, scenes, random)
    rand, randn = draws(speed.shape, random)

    # What drivers ask for now, m/s2; they did that in part so far, or something else.
    wanted = prior_acceleration(vehicles, road, headway)
    otherwise = rand() < 0.5
    something_else = 0.6 * randn()
    in_part = (wanted * rand()).clamp(-6.0, 2.0)
    before = torch.where(otherwise, something_else, in_part)
    vehicles = vehicles.with_(acceleration=before)
    view = perceive(vehicles, road)

    # A memory that fits to this, up to noise: the style shows the headway, as it does in traffic.
    history = before[..., None] + 0.4 * randn(*speed.shape, ACCELERATIONS)
    history[..., 0] = before
    style = (
        torch.log(headway) + 0.2 * randn(),
        # The mean square of the acceleration, and the pace.
        0.5 * rand(),
        0.5 * randn(),
    )
    memory = Memory(
        accelerations=history,
        style=torch.stack(style, -1),
        lateral_speeds=aside[..., None] + 0.03 * randn(*speed.shape, 2),
        age=12.0 * rand(),
        since=12.0 * rand(),
        closing=view.closing[..., None] + 0.3 * randn(*speed.shape, 2),
    )
    situation = Situation(vehicles, memory, road, view)

    # Recordings are silent at high speed, at a standstill, on a free road and before a collision.
    time_to_collision_s = view.gap / (-view.closing).clamp_min(1e-3)
    headway_now_s = view.gap / speed.clamp_min(1.0)
    silent = (speed > FASTEST_MPS) | (speed < 1.5) | (view.gap > 80.0)
    silent |= (time_to_collision_s < 4.0) | (headway_now_s < 0.5)
    # Few overlap.
    overlaps = view.gap < 0.0
    silent &= ~(overlaps & (rand() < 0.8))

    # They show few who are far from the centre of the lane that they head for, m.
    from_target = vehicles.y - road.centre_of(vehicles.target_lane)
    far_off = from_target.abs() > 0.75

    # Along: half of the way to IDM's acceleration, all of it where that is hard braking.
    hard = wanted < -2.0
    change = torch.where(hard, 1.0, 0.5) * (wanted - before)
    change = change + torch.where(hard, 0.05, 0.18) * randn()
    # Across: back to the lane's centre within some two seconds.
    from_centre = vehicles.y - road.centre_of(lane)
    back = (-0.45 * from_centre).clamp(-0.9, 0.9)
    sideways = 0.4 * (back - aside) + 0.03 * randn()

    moves = Moves(
        features=features_of(situation),
        change=change,
        aside=sideways,
        weight=silent.float(),
        lateral_weight=torch.where(far_off, 0.5, 0.1),
    )
    sides = lane_choice(situation).sides
    danger = sides[~leaves_room(sides) & view.exists]
    return moves.rows(silent | far_off), danger
