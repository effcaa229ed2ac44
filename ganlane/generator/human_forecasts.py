"""Forecasts of recorded drivers by ``human``.

The present follows from nine noisy positions (:mod:`ganlane.generator.human_estimator`). From there
on the policy drives everybody in the scene, by expected moves (the mean driver) or by drawn ones
(samples). What a recording shows besides, its camera's errors, is added for the first second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
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
    Observer,
    error_in,
    other_noise,
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

# Of the observer's fit.
#: Shares of the recorded noise; every scene is used with each of them.
NOISE_SHARES = (0.0, 0.5, 1.0, 1.2)
#: And so often with the noise of another sensor in its place.
OTHER_COPIES = 2
#: Frames between the starts of two windows.
OBSERVER_STRIDE = 2
#: Windows of an update.
OBSERVER_BATCH = 512
#: The highest learning rate.
OBSERVER_RATE = 3e-3


def present_of(estimator: Estimator, segments: Segments) -> Situation:
    """The drivers at the present of B segments of V vehicles.

    Who was not recorded in all of the nine frames has driven at constant velocity so far.

    Args:
        estimator: finds speeds and accelerations in nine noisy positions.
        segments: only their observed frames are used.

    Returns:
        Vehicles, memories and views [B, V]. Desired speeds are not known: they are taken to be
        :data:`DESIRED_ABOVE_MPS` above the present ones.
    """
    # Nine positions [B, V, 9, 2] of a driver, and whether all of them were recorded.
    whole = segments.present[:, :OBSERVED_POSITIONS].all(1)
    nine = segments.positions[:, :OBSERVED_POSITIONS].transpose(1, 2)
    last = nine[:, :, -1]

    # The motion [B, V, 7] in the order of the estimator's numbers. All of them are 0 where frames
    # are missing: no acceleration, and the last position as recorded.
    estimated = estimator(nine - last[:, :, None])
    motion = torch.where(whole[..., None], estimated, 0.0)
    latest = (nine[:, :, -1, 0] - nine[:, :, -2, 0]) / PHYSICS_STEP_S
    speed = torch.where(whole, motion[..., 0], latest).clamp_min(0.0)
    aside = motion[..., 3]

    # The last position is noisy, too: the estimator says by how much it is wrong.
    x, y = (last + motion[..., 5:]).unbind(-1)

    # Who moves away from its lane's centre is on its way to the next lane. A recording's target
    # lanes are not asked: they follow from what drivers do later.
    road = segments.road
    lane = road.lane_of(y)
    outwards = (y - road.centre_of(lane)) * aside > 0.1
    leaving = (aside.abs() > CHANGING_MPS) & outwards
    next_lane = lane_after(y, aside, road, 1.5)
    target_lane = torch.where(leaving, next_lane, lane)

    vehicles = cars(
        x,
        y,
        speed,
        aside,
        acceleration=motion[..., 1],
        length=segments.length.clamp_min(1.0),
        width=torch.full_like(x, WIDTH_M),
        desired_speed=(speed + DESIRED_ABOVE_MPS).clamp(*DESIRED_MPS),
        target_lane=target_lane.long(),
        valid=segments.present[:, PRESENT],
    )

    # For how many decisions a driver counts as seen: the noisier its positions, the fewer.
    age = torch.where(whole, trust(nine), 0.0)
    memory = present_memory(motion, age)
    return situation_of(vehicles, memory, road, first=torch.ones_like(whole))


def human_driver(model: HumanModel, samples: int) -> Driver:
    """A driver of forecasts: the mean one, then drawn ones.

    Every call of this function begins the same random numbers anew.

    Args:
        model: a fitted one, whose policy drives everybody in a segment.
        samples: how many forecasts are drawn beside the mean one.

    Returns:
        A function of segments, to positions [1 + ``samples``, B, H, V, 2] in m.
    """
    random = torch.Generator().manual_seed(0)
    return partial(_driven, model, samples, random)


def _driven(
    model: HumanModel,
    samples: int,
    random: torch.Generator,
    segments: Segments,
) -> Tensor:
    """Positions [1 + samples, B, H, V, 2] in m; the first are the mean driver's.

    All drivers of a run move together, so that they react to each other's forecasts.
    """
    policy = model.policy
    horizon = segments.future.shape[1]

    # All runs are rows of one batch [N, V], N = runs * rows. The first copy of the segments makes
    # the expected moves, the others draw theirs.
    runs = 1 + samples
    rows = len(segments.positions)
    situation = present_of(model.estimator, segments.repeated(runs))
    mean = torch.zeros_like(situation.vehicles.valid)
    mean[:rows] = True

    # Who leads the scene at the present counts as its leader throughout.
    leads = situation.view.gap >= SIGHT_M

    # Times within a decision [4, 1, 1], s.
    steps = (torch.arange(1, STEPS + 1) * PHYSICS_STEP_S)[:, None, None]
    half = 0.5 * steps**2

    # As many decisions as cover the horizon; the last one may end after it.
    decisions = math.ceil(horizon / STEPS)
    course = []
    for _ in range(decisions):
        # Lanes: the mean driver goes on as it does.
        lanes = lane_choice(situation)
        chances = policy.lane_chances(lanes, HumanVariation.lane_changes)
        u = torch.rand(mean.shape, generator=random)
        choice = chosen(chances, u).masked_fill(mean, 0)
        situation = with_choice(situation, choice)

        # Moves: changes of the acceleration, m/s2, and of the lateral speed, m/s, [N, V].
        changes = []
        for tokens, logits in zip((ALONG, ACROSS), policy(features_of(situation))):
            u = torch.rand(mean.shape, generator=random)
            drawn = tokens.sample(logits, u, HumanVariation.temperature)
            changes.append(torch.where(mean, tokens.mean(logits), drawn))

        # A policy that sees no leader would speed up. What it does now only fades.
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

    # [H, N, V, 2] -> [runs, B, H, V, 2].
    positions = torch.cat(course)[:horizon]
    positions = positions.transpose(0, 1).unflatten(0, (runs, rows))
    return positions + _seen_besides(model, segments, positions[0])


def _seen_besides(model: HumanModel, segments: Segments, mean: Tensor) -> Tensor:
    """What the observer adds to positions, [B, H, V, 2] in m.

    All of it in the 0.8 s that it was fitted to; 0.8 s later it has faded. Runs have it in common:
    a camera's errors do not depend on what a driver decides.

    Args:
        model: whose observer is asked.
        segments: with the observed positions.
        mean: the mean driver's positions, [B, H, V, 2] in m.
    """
    # Per driver and relative to its present place, as the observer expects: [B, V, 9 or 8, 2].
    nine = segments.positions[:, :OBSERVED_POSITIONS].transpose(1, 2)
    ahead = mean[:, :PREDICTED_STEPS].transpose(1, 2)
    present = nine[:, :, -1:]
    difference = model.observer(nine - present, ahead - present)

    # Per step again, [B, 8, V, 2]. Nothing for a driver who was not recorded in all nine frames.
    whole = segments.present[:, :OBSERVED_POSITIONS].all(1)
    difference = difference.transpose(1, 2)
    difference = torch.where(whole[:, None, :, None], difference, 0.0)

    # The last difference goes on, with a share that falls from 1 to 0.
    step = torch.arange(mean.shape[1])
    share = (2.0 - (step + 1) / PREDICTED_STEPS).clamp(0.0, 1.0)
    fitted_step = step.clamp_max(PREDICTED_STEPS - 1)
    return share[:, None, None] * difference[:, fitted_step]


def fit_observer(model: HumanModel, scenes: Sequence[Recording], config: HumanConfig) -> None:
    """Fit the observer of ``model`` to what its policy misses in these scenes.

    First they have none, half, all and more of their noise, so that the observer adds nothing where
    a recording has none. Then they also have that of other sensors, whose next errors can hardly be
    known. With both from the start it predicts the recorded noise worse.

    Args:
        model: one of :func:`ganlane.generator.human_fit.fit_human`; it is changed in place.
        scenes: recordings of several lanes, as those of the policy's fit.
        config: seed, smoothing, and how many updates there are (``observing``) in both parts.
    """
    random = torch.Generator().manual_seed(config.seed)
    observer = model.observer.requires_grad_(True)
    # The forecasts that it corrects are without it: it begins with differences of 0.
    for parameter in observer.layers[-1].parameters():
        nn.init.zeros_(parameter)

    def recorded_and_driven(segments: Segments) -> Tensor:
        """Positions [1, B, 9 + 8 + 8, V, 2]: the recorded ones, then those of the mean driver."""
        mean = _driven(model, 0, random, segments)
        return torch.cat((segments.positions[None], mean), 2)

    # Windows [W, 9 + 8 + 8, 2]: observed positions, the recorded next ones, and the forecast.
    parts = []
    for noisy in noisy_scenes(scenes, config, random):
        (windows,) = driven_windows(
            recorded_and_driven,
            noisy,
            PREDICTED_STEPS,
            OBSERVER_STRIDE,
        )
        parts.append(torch.from_numpy(windows).float())

    recorded, other = parts
    _fit_to_windows(observer, recorded, config.observing, random)
    _fit_to_windows(observer, torch.cat((recorded, other)), config.observing, random)
    observer.requires_grad_(False)


def noisy_scenes(
    scenes: Sequence[Recording],
    config: HumanConfig,
    random: torch.Generator,
) -> tuple[list[Recording], list[Recording]]:
    """The scenes smoothed, with shares of their own noise, and with that of other sensors."""
    recorded = []
    other = []
    for scene in scenes:
        smooth = smooth_scene(scene, config)
        exact = replace(scene, x=smooth.x, y=smooth.y)

        # What smoothing takes away.
        noise = np.stack((scene.x - smooth.x, scene.y - smooth.y), -1)
        for share in NOISE_SHARES:
            recorded.append(_with_noise(exact, share * noise))

        frames, vehicles = scene.present.shape
        for _ in range(OTHER_COPIES):
            noise = other_noise(vehicles, frames, random).transpose(0, 1).double().numpy()
            other.append(_with_noise(exact, noise))
    return recorded, other


def _with_noise(scene: Recording, noise: np.ndarray) -> Recording:
    """The scene with ``noise`` [T, V, 2] on the positions of those who are there, m."""
    there = scene.present
    return replace(scene, x=scene.x + there * noise[..., 0], y=scene.y + there * noise[..., 1])


def _fit_to_windows(
    observer: Observer,
    windows: Tensor,
    updates: int,
    random: torch.Generator,
) -> None:
    """Fit the observer to windows [W, 9 + 8 + 8, 2], as in :func:`fit_observer`."""
    parts = (OBSERVED_POSITIONS, PREDICTED_STEPS, PREDICTED_STEPS)
    positions, wanted, forecast = windows.split(parts, 1)

    # What is learnt is the recorded position less the forecast one.
    optimizer = torch.optim.AdamW(observer.parameters(), OBSERVER_RATE, weight_decay=1e-2)
    for update in range(updates):
        optimizer.param_groups[0]["lr"] = OBSERVER_RATE * half_cosine(update, updates)
        rows = torch.randint(len(wanted), (OBSERVER_BATCH,), generator=random)

        # Left and right swapped in half of the rows; x stays: factors [B, 1, 2].
        side = random_sides(OBSERVER_BATCH, random)
        mirror = torch.stack((torch.ones_like(side), side), -1)
        seen = mirror * positions[rows]
        ahead = mirror * forecast[rows]
        missed = mirror * wanted[rows] - ahead

        difference = observer(seen, ahead) - missed
        descend(optimizer, error_in(difference, DIFFERENCE_SCALE))
