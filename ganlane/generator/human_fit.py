"""The fit of ``human``: cloning, then samples in closed loop; fine-tuning follows it.

Cloning alone drifts, since a clone never sees its own mistakes. So the policy drives the recorded
scenes itself: of several moves that it draws, the nearest to the recording is made, and the target
is what leads back to it. Where recordings are silent (fast, free, standing, about to collide, off
the lane) samples of IDM drivers with headways of their own stand in.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

from ganlane.data.dense import Recording
from ganlane.generator.descent import descend, half_cosine
from ganlane.generator.human import (
    ACCELERATIONS,
    ACROSS,
    ALONG,
    HumanPolicy,
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
from ganlane.generator.human_tuning import Report, begins_per_decision, tune
from ganlane.settings.generator import HumanConfig
from ganlane.sim.idm import IdmParameters, following_acceleration, with_headways
from ganlane.sim.neighbours import perceive as scene_of
from ganlane.sim.state import Road

#: Decisions of a segment: of whole scenes, and short ones, which begin more often as recorded.
LONG_DECISIONS, SHORT_DECISIONS = 20, 5
#: Weight of samples from files of one lane.
ONE_LANE_WEIGHT = 0.5
#: Random scenes of the prior, and vehicles in each.
PRIOR_SCENES, PRIOR_VEHICLES = 9000, 8
#: How much more strongly the policy is pulled to what it is in the second fine-tuning.
SETTLING_TIMES = 2.0
#: Samples of an update, and of the prior beside them.
BATCH = 1024
PRIOR_SHARE = 0.15
#: Noise on the inputs, so that the policy does not hang on their last digits.
INPUT_NOISE = 0.02
#: Updates of the lane choice, its learning rate and decay: lane changes are few.
LANE_UPDATES, LANE_RATE, LANE_DECAY = 300, 3e-3, 0.05


def fit_steps(config: HumanConfig) -> int:
    """Steps of a fit: cloning, rounds in closed loop, and the iterations of both fine-tunings."""
    return 1 + config.rounds + config.tuning + config.settling


class Material(NamedTuple):
    """What a policy is fitted to: stretches of recordings, and the prior's samples.

    ``around`` and ``ahead`` are stretches of two-dimensional scenes and of one lane; ``short`` are
    short ones of both; ``danger`` are lane changes that nobody survives, [D, SIDE_FEATURES].
    """

    around: list[Cut]
    ahead: list[Cut]
    short: list[Cut]
    prior: Moves
    danger: Tensor


def material_of(scenes: Sequence[SmoothScene], random: torch.Generator) -> Material:
    """Everything that a policy is fitted to."""
    wide = [scene for scene in scenes if scene.two_dimensional]
    narrow = [scene for scene in scenes if not scene.two_dimensional]
    prior, danger = prior_samples(random)
    return Material(
        cuts(wide, LONG_DECISIONS, 10),
        cuts(narrow, LONG_DECISIONS, 60),
        [*cuts(wide, SHORT_DECISIONS, 4), *cuts(narrow, SHORT_DECISIONS, 40)],
        prior,
        danger,
    )


def fit_human(
    config: HumanConfig,
    recordings: Sequence[Recording],
    following: Sequence[Recording] = (),
    report: Report = lambda cost: None,
) -> HumanModel:
    """Fit a model to ``recordings`` of several lanes and to cars ``following`` each other in one.

    It is in evaluation mode. Each of the :func:`fit_steps` is reported.
    """
    # Networks draw their first weights from torch's own generator, which stays the caller's.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        random = torch.Generator().manual_seed(config.seed)
        model = HumanModel(config.sizes)
        scenes = [smooth_scene(recording, config) for recording in recordings]
        exact = [without_noise(recording, config) for recording in recordings]
        fit_estimator(model.estimator, [*scenes, *exact], random)
        scenes += [smooth_scene(one, config, ONE_LANE_WEIGHT) for one in following]
        material = material_of(scenes, random)
        # Lane changes are few: none of them is hidden, as the sides are from some of the moves.
        choices = _gathered(material, Options(blind=0.0), config, random, times=2).choices
        teacher = _gathered(material, Options(), config, random, times=3).moves
        policy, danger = model.policy, material.danger
        for rate in (config.learning_rate, 0.5 * config.learning_rate):
            train_moves(policy, teacher, material.prior, max(1, config.epochs // 2), rate, random)
        train_lane_choice(policy, choices, danger, random)
        match_rate(policy, choices)
        report(None)
        close_the_loop(model, material, teacher, config, random, report)
        tune(policy, choices, danger, config.tuning, config.pull, random, report)
        match_rate(policy, choices)
        # More lane changes bring new accidents: it learns to do without them at this level.
        pull = SETTLING_TIMES * config.pull
        tune(policy, None, danger, config.settling, pull, random, report)
        return model.eval().requires_grad_(False)


def close_the_loop(
    model: HumanModel,
    material: Material,
    teacher: Moves,
    config: HumanConfig,
    random: torch.Generator,
    report: Report,
) -> None:
    """Rounds of closed-loop samples: the last two rounds and as many teacher samples count."""
    bank: list[Moves] = []
    options = Options(model.policy, samples=config.samples)
    noisy = options._replace(estimator=model.estimator)
    for number in range(config.rounds):
        # Long stretches begin as recorded, short ones as nine noisy positions show drivers.
        long = _gathered(material, options, config, random, times=2)
        latest = joined([long, samples_of(material.short, noisy, random)]).moves
        bank = [*bank[-1:], latest]
        rows = torch.randperm(len(teacher.change), generator=random)[: len(latest.change)]
        moves = Moves(*map(torch.cat, zip(teacher.rows(rows), *bank)))
        # From half of the cloning's rate down to a sixth of it.
        rate = 0.5 * config.learning_rate * (1.0 - 0.7 * number / max(1, config.rounds - 1))
        epochs = max(1, config.epochs // 3)
        train_moves(model.policy, moves, material.prior, epochs, rate, random)
        report(None)


def _gathered(
    material: Material, options: Options, config: HumanConfig, random: torch.Generator, times: int
) -> Samples:
    """Samples of all stretches, ``times`` over; in the last pass they are lengthened."""
    scales = [0.0] * (times - 1) + [config.scale]
    parts = [samples_of(material.around, options._replace(scale=scale), random) for scale in scales]
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
    """Fit the distributions to ``moves``, with the prior's beside them, by the cross-entropies of
    the wanted changes along and across.
    """
    parts = (policy.trunk, policy.along, policy.across)
    parameters = [parameter for part in parts for parameter in part.parameters()]
    optimizer = torch.optim.AdamW(parameters, lr=rate, weight_decay=1e-3, fused=True)
    rows = len(moves.change)
    updates = max(1, epochs * (rows // BATCH))
    update = 0
    for _ in range(epochs):
        for batch in torch.randperm(rows, generator=random).split(BATCH):
            beside = int(PRIOR_SHARE * len(batch))
            also = torch.randint(len(prior.change), (beside,), generator=random)
            both = Moves(*map(torch.cat, zip(moves.rows(batch), prior.rows(also))))
            noise = INPUT_NOISE * torch.randn(both.features.shape, generator=random)
            along, across = policy(both.features + noise)
            losses = -(ALONG.soft_target(both.change) * along.log_softmax(-1)).sum(-1)
            lateral = -(ACROSS.soft_target(both.aside) * across.log_softmax(-1)).sum(-1)
            loss = (losses * both.weight + lateral * both.lateral_weight).mean()
            # A short warm-up, then a half cosine to 0.
            rise = min(1.0, (update + 1) / 100)
            optimizer.param_groups[0]["lr"] = rate * (rise * half_cosine(update, updates))
            descend(optimizer, loss, 5.0)
            update += 1


def train_lane_choice(
    policy: HumanPolicy, choices: Choices, danger: Tensor, random: torch.Generator
) -> None:
    """Fit when a lane change begins, and when one is broken off.

    Beginning is a logistic regression on the recorded ones; nobody begins one into danger. Changes
    under way go on as recorded ones did, and are broken off in danger.
    """
    begun = choices.sides[choices.begins == 1]
    not_begun = choices.sides[choices.begins == 0]
    under_way = choices.sides[choices.begins < 0]
    if not len(begun):
        return  # without a recorded change nobody changes lanes
    weight, bias = policy.lane[-1].parameters()
    with torch.no_grad():
        # From the recorded rate on.
        bias.copy_(torch.tensor([math.log(len(begun) / len(not_begun)), -2.0]))
        weight.mul_(0.1)
    optimizer = torch.optim.AdamW(policy.lane.parameters(), lr=LANE_RATE, weight_decay=LANE_DECAY)
    for _ in range(LANE_UPDATES):
        rows = torch.randint(len(not_begun), (4096,), generator=random)
        others = torch.randint(len(danger), (1024,), generator=random)
        begins = policy.lane(begun)[:, 0]
        stays = policy.lane(not_begun[rows])[:, 0]
        in_danger = policy.lane(danger[others])
        scale = len(not_begun) / len(rows)
        # Per recorded change, so that few count as much as many.
        loss = (softplus(-begins).sum() + scale * softplus(stays).sum()) / len(begun)
        loss = loss + 2.0 * softplus(in_danger[:, 0] + 10.0).mean()
        loss = loss + softplus(-in_danger[:, 1]).mean()
        if len(under_way):
            loss = loss + 2.0 * softplus(policy.lane(under_way)[:, 1] + 1.0).mean()
        descend(optimizer, loss)


@torch.no_grad()
def match_rate(policy: HumanPolicy, choices: Choices) -> None:
    """Let lane changes begin as often as recorded ones did, over the recorded states.

    Where recorded drivers took gaps that count as danger here, no change begins; others make up for
    it. Only the level is moved: the bias of all beginnings.
    """
    wanted = begins_per_decision(choices)
    _, bias = policy.lane[-1].parameters()
    choice = choices.keeping(slice(None))
    unmoved = bias[0].clone()
    low, high = -6.0, 6.0
    # Bisection: the rate grows with the bias.
    for _ in range(20):
        middle = 0.5 * (low + high)
        bias[0] = unmoved + middle
        begins = float(policy.lane_chances(choice)[:, 1:].sum(-1).mean())
        low, high = (middle, high) if begins < wanted else (low, middle)


@torch.no_grad()
def prior_samples(random: torch.Generator, scenes: int = PRIOR_SCENES) -> tuple[Moves, Tensor]:
    """IDM drivers with headways of their own where recordings show nothing, and lane changes into
    danger [D, SIDE_FEATURES].
    """
    shape = (scenes, PRIOR_VEHICLES)
    rand, randn = draws(shape, random)
    road = Road(3, 3.6)
    lane = torch.randint(0, 3, shape, generator=random)
    # A third of the drivers is somewhere between two lanes.
    astray = rand() < 0.35
    y = lane * 3.6 + torch.where(astray, 3.2, 0.5) * (rand() - 0.5)
    pace = 36.0 * rand(scenes, 1) ** 0.8
    speed = (pace + 6.0 * randn() * rand(scenes, 1)).clamp(0.0, 38.0)
    speed = torch.where(rand() < 0.08, 3.0 * rand(), speed)
    desired = torch.where(rand() < 0.5, 14.0 + 20.0 * rand(), speed + 8.0 * rand())
    headway = torch.exp(math.log(1.25) + 0.42 * randn()).clamp(0.5, 3.0)
    aside = torch.where(astray, 0.45, 0.15) * randn()
    target = torch.where(astray, road.lane_of(y).long(), lane)
    whole = torch.full(shape, 1.0)
    vehicles = cars(
        rand() * (60.0 + 500.0 * rand(scenes, 1)),
        y,
        speed,
        aside,
        acceleration=0.0 * whole,
        length=4.5 * whole,
        width=1.9 * whole,
        desired_speed=desired.clamp(*DESIRED_MPS),
        target_lane=target,
    )
    idm = IdmParameters(comfortable_deceleration=2.0, min_acceleration=-8.0, max_acceleration=1.4)
    wanted = following_acceleration(scene_of(vehicles, road), with_headways(idm, headway))
    before = torch.where(rand() < 0.5, 0.6 * randn(), (wanted * rand()).clamp(-6.0, 2.0))
    history = before[..., None] + 0.4 * randn(*shape, ACCELERATIONS)
    history[..., 0] = before
    style = torch.stack((torch.log(headway) + 0.2 * randn(), 0.5 * rand(), 0.5 * randn()), -1)
    lateral = aside[..., None] + 0.03 * randn(*shape, 2)
    none = torch.zeros(*shape, 2)
    memory = Memory(history, lateral, none, style, 12.0 * rand(), 12.0 * rand())
    vehicles = vehicles.with_(acceleration=before)
    view = perceive(vehicles, road)
    memory = memory._replace(closing=view.closing[..., None] + 0.3 * randn(*shape, 2))
    situation = Situation(vehicles, memory, road, view)

    time_to_collision = view.gap / (-view.closing).clamp_min(1e-3)
    silent = (speed > 19.0) | (speed < 1.5) | (view.gap > 80.0)
    silent |= (time_to_collision < 4.0) | (view.gap / speed.clamp_min(1.0) < 0.5)
    # Few overlap.
    silent &= ~((view.gap < 0.0) & (rand() < 0.8))
    far_off = (y - road.centre_of(target)).abs() > 0.75

    # Half of the way to IDM's acceleration, all of it where that is hard braking.
    hard = wanted < -2.0
    change = torch.where(hard, 1.0, 0.5) * (wanted - before)
    change = change + torch.where(hard, 0.05, 0.18) * randn()
    back = (-0.45 * (y - road.centre_of(lane))).clamp(-0.9, 0.9)
    sideways = 0.4 * (back - aside) + 0.03 * randn()
    lateral_weight = torch.where(far_off, 0.5, 0.1)
    moves = Moves(features_of(situation), change, sideways, silent.float(), lateral_weight)
    sides = lane_choice(situation).sides
    return moves.rows(silent | far_off), sides[~leaves_room(sides) & view.exists]
