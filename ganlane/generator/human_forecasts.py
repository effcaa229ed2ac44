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

    Who was not recorded in all of the nine frames has driven at constant velocity so far.
    """
    # Nine positions [B, V, 9, 2] of a driver, and whether all of them were recorded.
    whole = segments.present[:, :OBSERVED_POSITIONS].all(1)
    nine = segments.positions[:, :OBSERVED_POSITIONS].transpose(1, 2)
    last = nine[:, :, -1]

    # The motion [B, V, 7] in the order of the estimator's numbers.
    motion = torch.where(whole[..., None], estimator(nine - last[:, :, None]), 0.0)
    latest = (nine[:, :, -1, 0] - nine[:, :, -2, 0]) / PHYSICS_STEP_S
    speed = torch.where(whole, motion[..., 0], latest).clamp_min(0.0)
    aside = motion[..., 3]
    x, y = (last + motion[..., 5:]).unbind(-1)

    # Who moves away from its lane's centre is on its way to the next lane.
    road = segments.road
    lane = road.lane_of(y)
    outwards = (y - road.centre_of(lane)) * aside > 0.1
    leaving = (aside.abs() > CHANGING_MPS) & outwards
    next_lane = lane_after(y, aside, road, 1.5)

    vehicles = cars(
        x,
        y,
        speed,
        aside,
        acceleration=motion[..., 1],
        length=segments.length.clamp_min(1.0),
        width=torch.full_like(x, WIDTH_M),
        desired_speed=(speed + DESIRED_ABOVE_MPS).clamp(*DESIRED_MPS),
        target_lane=torch.where(leaving, next_lane, lane).long(),
        valid=segments.present[:, PRESENT],
    )
    memory = present_memory(motion, torch.where(whole, trust(nine), 0.0))
    return situation_of(vehicles, memory, road, first=torch.ones_like(whole))


def human_driver(model: HumanModel, samples: int) -> Driver:
    """A driver of forecasts [1 + ``samples``, B, H, V, 2]: the mean one, then drawn ones.

    Every call of this function begins the same random numbers anew.
    """
    random = torch.Generator().manual_seed(0)
    return partial(_driven, model, samples, random)


def _driven(model: HumanModel, samples: int, random: torch.Generator, segments: Segments) -> Tensor:
    """Positions [1 + samples, B, H, V, 2] in m; the first are the mean driver's."""
    policy = model.policy
    horizon = segments.future.shape[1]

    # All runs are rows of one batch [N, V], N = runs * rows. The first copy of the segments makes
    # the expected moves, the others draw theirs.
    runs, rows = 1 + samples, len(segments.positions)
    situation = present_of(model.estimator, segments.repeated(runs))
    mean = torch.zeros_like(situation.vehicles.valid)
    mean[:rows] = True
    leads = situation.view.gap >= SIGHT_M

    # Times within a decision [4, 1, 1], s.
    steps = (torch.arange(1, STEPS + 1) * PHYSICS_STEP_S)[:, None, None]
    half = 0.5 * steps**2
    course = []
    for _ in range(-(-horizon // STEPS)):
        # Lanes: the mean driver goes on as it does.
        chances = policy.lane_chances(lane_choice(situation), HumanVariation.lane_changes)
        u = torch.rand(mean.shape, generator=random)
        choice = chosen(chances, u).masked_fill(mean, 0)
        situation = with_choice(situation, choice)

        # Moves: changes of the acceleration, m/s2, and of the lateral speed, m/s, [N, V].
        changes = []
        for tokens, logits in zip((ALONG, ACROSS), policy(features_of(situation))):
            u = torch.rand(mean.shape, generator=random)
            drawn = tokens.sample(logits, u, HumanVariation.temperature)
            changes.append(torch.where(mean, tokens.mean(logits), drawn))

        # A policy that sees no leader would speed up.
        vehicles, memory, road, view = situation
        fading = (LEFT_OF_ACCELERATION - 1.0) * memory.accelerations[..., 0]
        changes[0] = torch.where(leads, fading, changes[0])
        acceleration, aside = bounded(situation, *changes)

        # Positions [4, N, V, 2]: constant acceleration, the lateral speed changing evenly.
        x = vehicles.x + view.speed * steps + half * acceleration
        y = vehicles.y + view.aside * steps + half * (aside - view.aside) / DECISION_S
        course.append(torch.stack((x, y), -1))

        later = moved(vehicles, acceleration, aside)
        situation = situation_of(later, remembered(situation, acceleration), road)
    positions = torch.cat(course)[:horizon].transpose(0, 1).unflatten(0, (runs, rows))
    return positions + _seen_besides(model, segments, positions[0])


def _seen_besides(model: HumanModel, segments: Segments, mean: Tensor) -> Tensor:
    """What the observer adds to positions, [B, H, V, 2] in m; ``mean`` are the mean driver's.

    All of it in the 0.8 s that it was fitted to; 0.8 s later it has faded.
    """
    # Per driver and relative to its present place, as the observer expects: [B, V, 9 or 8, 2].
    nine = segments.positions[:, :OBSERVED_POSITIONS].transpose(1, 2)
    ahead = mean[:, :PREDICTED_STEPS].transpose(1, 2)
    present = nine[:, :, -1:]
    difference = model.observer(nine - present, ahead - present).transpose(1, 2)

    # Nothing for a driver who was not recorded in all nine frames.
    whole = segments.present[:, :OBSERVED_POSITIONS].all(1)
    difference = torch.where(whole[:, None, :, None], difference, 0.0)

    # The last difference goes on, with a share that falls from 1 to 0.
    step = torch.arange(mean.shape[1])
    share = (2.0 - (step + 1) / PREDICTED_STEPS).clamp(0.0, 1.0)
    return share[:, None, None] * difference[:, step.clamp_max(PREDICTED_STEPS - 1)]


def fit_observer(model: HumanModel, scenes: Sequence[Recording], config: HumanConfig) -> None:
    """Fit the observer of ``model`` to what its policy misses in these scenes.

    Every scene counts with none, half, all and more of its noise, so that the observer adds nothing
    where a recording has none.

    Args:
        model: one of :func:`ganlane.generator.human_fit.fit_human`; it is changed in place.
        scenes: recordings of several lanes, as those of the policy's fit.
        config: seed, smoothing, and how many updates there are (``observing``).
    """
    random = torch.Generator().manual_seed(config.seed)

    def recorded_and_driven(segments: Segments) -> Tensor:
        mean = _driven(model, 0, random, segments)
        return torch.cat((segments.positions[None], mean), 2)

    # The forecasts that it corrects are without it: it begins with differences of 0.
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

    # Windows [W, 9 + 8 + 8, 2]: observed positions, the recorded next ones, and the forecast.
    (windows,) = driven_windows(recorded_and_driven, noisy, PREDICTED_STEPS, OBSERVER_STRIDE)
    parts = (OBSERVED_POSITIONS, PREDICTED_STEPS, PREDICTED_STEPS)
    positions, wanted, forecast = torch.from_numpy(windows).float().split(parts, 1)

    optimizer = torch.optim.AdamW(model.observer.parameters(), OBSERVER_RATE, weight_decay=1e-2)
    for update in range(config.observing):
        optimizer.param_groups[0]["lr"] = OBSERVER_RATE * half_cosine(update, config.observing)
        rows = torch.randint(len(wanted), (OBSERVER_BATCH,), generator=random)

        # Left and right swapped in half of the rows; x stays: factors [B, 1, 2].
        side = random_sides(OBSERVER_BATCH, random)
        mirror = torch.stack((torch.ones_like(side), side), -1)
        seen, ahead = mirror * positions[rows], mirror * forecast[rows]
        missed = mirror * wanted[rows] - ahead
        difference = model.observer(seen, ahead) - missed
        descend(optimizer, error_in(difference, DIFFERENCE_SCALE))
    model.observer.requires_grad_(False)
