"""Forecasts of recorded drivers by ``human``.

The present follows from nine noisy positions (:mod:`ganlane.generator.human_estimator`). From there
on the policy drives everybody in the scene, by expected moves (the mean driver) or by drawn ones
(samples). What a recording shows besides, its camera's errors, is added for the first second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from ganlane.data.dense import Recording
from ganlane.generator.descent import descend, half_cosine
from ganlane.generator.forecasts import Driver, driven_windows
from ganlane.generator.human import (
    ACROSS,
    ALONG,
    DECISION_S,
    SIGHT_M,
    STEPS,
    Situation,
    bounded,
    cars,
    chosen,
    features_of,
    lane_after,
    lane_choice,
    moved,
    remembered,
    situation_of,
    with_choice,
)
from ganlane.generator.human_estimator import (
    DIFFERENCE_SCALE,
    Estimator,
    HumanModel,
    error_in,
    present_memory,
    random_sides,
    trust,
)
from ganlane.generator.human_samples import DESIRED_MPS, smooth_scene
from ganlane.generator.windows import OBSERVED_POSITIONS, PREDICTED_STEPS, PRESENT, Segments
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.driving import HumanVariation
from ganlane.settings.generator import HumanConfig

#: A driver's desired speed is its present one and this much, m/s.
DESIRED_ABOVE_MPS = 4.0
#: What is left after a decision of the acceleration of a driver who leads the recorded scene: its
#: leader was not recorded, and an acceleration lasts for about a second.
LEFT_OF_ACCELERATION = 0.6
#: Width of a body where none is recorded, m.
WIDTH_M = 1.9
#: Who moves aside faster than this, m/s, away from its lane's centre, is changing lanes.
CHANGING_MPS = 0.35
#: Of the observer's fit: shares of the noise, frames between windows, batch and learning rate.
NOISE_SHARES = (0.0, 0.5, 1.0, 1.2)
OBSERVER_STRIDE, OBSERVER_BATCH, OBSERVER_RATE = 2, 512, 3e-3


def present_of(estimator: Estimator, segments: Segments) -> Situation:
    """The drivers at the present of segments [B, V].

    Who was not recorded in all of the nine frames goes on at constant velocity so far.
    """
    whole = segments.present[:, :OBSERVED_POSITIONS].all(1)
    nine = segments.positions[:, :OBSERVED_POSITIONS].transpose(1, 2)
    last = nine[:, :, -1]
    motion = torch.where(whole[..., None], estimator(nine - last[:, :, None]), 0.0)
    latest = (nine[:, :, -1, 0] - nine[:, :, -2, 0]) / PHYSICS_STEP_S
    speed = torch.where(whole, motion[..., 0], latest).clamp_min(0.0)
    aside = motion[..., 3]
    x, y = (last + motion[..., 5:]).unbind(-1)
    road = segments.road
    lane = road.lane_of(y)
    # Who moves away from its lane's centre is on its way to the next lane.
    leaving = (aside.abs() > CHANGING_MPS) & ((y - road.centre_of(lane)) * aside > 0.1)
    vehicles = cars(
        x,
        y,
        speed,
        aside,
        acceleration=motion[..., 1],
        length=segments.length.clamp_min(1.0),
        width=torch.full_like(x, WIDTH_M),
        desired_speed=(speed + DESIRED_ABOVE_MPS).clamp(*DESIRED_MPS),
        target_lane=torch.where(leaving, lane_after(y, aside, road, 1.5), lane).long(),
        valid=segments.present[:, PRESENT],
    )
    memory = present_memory(motion, torch.where(whole, trust(nine), 0.0))
    return situation_of(vehicles, memory, road, first=torch.ones_like(whole))


def human_driver(model: HumanModel, samples: int) -> Driver:
    """The mean driver, then so many drawn ones."""
    random = torch.Generator().manual_seed(0)
    return partial(_driven, model, samples, random)


def _driven(model: HumanModel, samples: int, random: torch.Generator, segments: Segments) -> Tensor:
    """Positions [1 + samples, B, H, V, 2]; the first are the mean driver's."""
    policy = model.policy
    horizon = segments.future.shape[1]
    runs, rows = 1 + samples, len(segments.positions)
    situation = present_of(model.estimator, segments.repeated(runs))
    # The first copy of the segments makes the expected moves, the others draw theirs.
    mean = torch.zeros_like(situation.vehicles.valid)
    mean[:rows] = True
    leads = situation.view.gap >= SIGHT_M
    temperature = HumanVariation.temperature
    steps = (torch.arange(1, STEPS + 1) * PHYSICS_STEP_S)[:, None, None]
    course = []
    for _ in range(-(-horizon // STEPS)):
        chances = policy.lane_chances(lane_choice(situation), HumanVariation.lane_changes)
        # The mean driver goes on as it does.
        choice = chosen(chances, torch.rand(mean.shape, generator=random)).masked_fill(mean, 0)
        situation = with_choice(situation, choice)
        changes = []
        for tokens, logits in zip((ALONG, ACROSS), policy(features_of(situation))):
            u = torch.rand(mean.shape, generator=random)
            drawn = tokens.sample(logits, u, temperature)
            changes.append(torch.where(mean, tokens.mean(logits), drawn))
        vehicles, memory, road, view = situation
        # A policy that sees no leader would speed up.
        fading = (LEFT_OF_ACCELERATION - 1.0) * memory.accelerations[..., 0]
        changes[0] = torch.where(leads, fading, changes[0])
        acceleration, aside = bounded(situation, *changes)
        # Within a decision: constant acceleration, the lateral speed changing evenly.
        half = 0.5 * steps**2
        x = vehicles.x + view.speed * steps + half * acceleration
        y = vehicles.y + view.aside * steps + half * (aside - view.aside) / DECISION_S
        course.append(torch.stack((x, y), -1))
        later = moved(vehicles, acceleration, aside)
        situation = situation_of(later, remembered(situation, acceleration), road)
    positions = torch.cat(course)[:horizon].transpose(0, 1).unflatten(0, (runs, rows))
    return positions + _seen_besides(model, segments, positions[0])


def _seen_besides(model: HumanModel, segments: Segments, mean: Tensor) -> Tensor:
    """What the observer adds to positions [B, H, V, 2]; as much again later it has faded."""
    nine = segments.positions[:, :OBSERVED_POSITIONS].transpose(1, 2)
    ahead = mean[:, :PREDICTED_STEPS].transpose(1, 2)
    present = nine[:, :, -1:]
    difference = model.observer(nine - present, ahead - present).transpose(1, 2)
    whole = segments.present[:, :OBSERVED_POSITIONS].all(1)
    difference = torch.where(whole[:, None, :, None], difference, 0.0)
    step = torch.arange(mean.shape[1])
    share = (2.0 - (step + 1) / PREDICTED_STEPS).clamp(0.0, 1.0)
    return share[:, None, None] * difference[:, step.clamp_max(PREDICTED_STEPS - 1)]


def fit_observer(model: HumanModel, scenes: Sequence[Recording], config: HumanConfig) -> None:
    """Fit the observer of ``model`` to what its policy misses in these scenes.

    Every scene counts with none, half, all and more of its noise, so that the observer adds nothing
    where a recording has none.
    """
    random = torch.Generator().manual_seed(config.seed)

    def recorded_and_driven(segments: Segments) -> Tensor:
        mean = _driven(model, 0, random, segments)
        return torch.cat((segments.positions[None], mean), 2)

    # The forecasts that it corrects are without it.
    model.observer.requires_grad_(True)
    for parameter in model.observer.layers[-1].parameters():
        nn.init.zeros_(parameter)
    smoothed = [smooth_scene(scene, config) for scene in scenes]
    noisy = []
    for share in NOISE_SHARES:
        for scene, smooth in zip(scenes, smoothed):
            x = smooth.x + share * (scene.x - smooth.x)
            y = smooth.y + share * (scene.y - smooth.y)
            noisy.append(replace(scene, x=x, y=y))
    (windows,) = driven_windows(recorded_and_driven, noisy, PREDICTED_STEPS, OBSERVER_STRIDE)
    parts = (OBSERVED_POSITIONS, PREDICTED_STEPS, PREDICTED_STEPS)
    positions, wanted, forecast = torch.from_numpy(windows).float().split(parts, 1)
    optimizer = torch.optim.AdamW(model.observer.parameters(), OBSERVER_RATE, weight_decay=1e-2)
    for update in range(config.observing):
        optimizer.param_groups[0]["lr"] = OBSERVER_RATE * half_cosine(update, config.observing)
        rows = torch.randint(len(wanted), (OBSERVER_BATCH,), generator=random)
        side = random_sides(OBSERVER_BATCH, random)
        mirror = torch.stack((torch.ones_like(side), side), -1)
        seen, ahead = mirror * positions[rows], mirror * forecast[rows]
        missed = mirror * wanted[rows] - ahead
        descend(optimizer, error_in(model.observer(seen, ahead) - missed, DIFFERENCE_SCALE))
    model.observer.requires_grad_(False)
