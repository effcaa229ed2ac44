"""Predicted courses of recorded windows, by the generators and by IDM, all in one form."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ganlane.generator.anchored import ANCHOR, AnchorParameters
from ganlane.generator.groups import group_windows
from ganlane.generator.history import displacement_of, moved_by
from ganlane.generator.metrics import SAMPLES
from ganlane.generator.networks import Generator
from ganlane.generator.rollout_metrics import Traits
from ganlane.generator.rollouts import drive, rollout
from ganlane.generator.stretches import RolloutScenes, SceneSource, cut_stretches
from ganlane.generator.traits import common_traits, typical_traits
from ganlane.generator.windows import PRESENT, Windows
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.following import following_acceleration
from ganlane.sim.idm import TABLE_V
from ganlane.sim.neighbours import perceive
from ganlane.sim.vehicles import Vehicles

#: Name of a forecast to predicted positions [W, T, 2] in m, relative to the window's present.
Forecasts = dict[str, np.ndarray]
BEST = f"best_of_{SAMPLES}"
#: Groups, and stretches times samples, in one pass; bounds the memory.
_GROUPS, _STRETCHES = 128, 160


def summarised(samples: np.ndarray, recorded: np.ndarray) -> Forecasts:
    """``mean`` (z = 0), ``single`` and ``best_of_20`` (by ADE) of courses [1 + K, W, T, 2], the first with z = 0."""
    if len(samples) < 2:
        return {"mean": samples[0]}
    errors = np.linalg.norm(samples[1:] - recorded, axis=-1).mean(-1)
    best = samples[1:][errors.argmin(0), np.arange(len(recorded))]
    return {"mean": samples[0], "single": samples[1]} | ({BEST: best} if len(samples) > SAMPLES else {})


@torch.no_grad()
def paper_forecasts(generator: Generator, windows: Windows, group_size: int = 9, seed: int = 0) -> Forecasts:
    """The paper's preset on k-means groups of the windows, open loop."""
    groups, random = group_windows(windows, group_size, seed), torch.Generator().manual_seed(seed)
    samples = np.empty((1 + SAMPLES, *windows.future.shape))
    for rows in torch.arange(len(groups)).split(_GROUPS):
        chunk = groups.select(rows)
        seen = generator.observe(chunk.displacements[..., : generator.sizes.observed, :], chunk.position, chunk.mask)
        noise = torch.randn(1 + SAMPLES, *chunk.mask.shape, generator.sizes.noise, generator=random)
        noise[0] = 0.0
        course = generator(seen, noise).cumsum(dim=-2)
        samples[:, chunk.window[chunk.mask].numpy()] = course[:, chunk.mask].double().numpy()
    return summarised(samples, windows.future)


#: Courses [K, B, H, V, 2] in m of a batch of stretches, everybody driven jointly.
Driver = Callable[[RolloutScenes], Tensor]


def driven_courses(
    driver: Driver, sources: list[SceneSource], horizon: int, stride: int, copies: int = 1
) -> np.ndarray:
    """What ``driver`` makes of every window of 9 + ``horizon`` frames, [K, W, H, 2] in m, relative to the present.

    The windows and their order are those of :func:`ganlane.generator.windows.cut_windows`: of a stretch those
    vehicles are kept that were recorded throughout. ``copies`` tells how often the driver repeats a stretch.
    """
    courses = []
    for scenes in _stretches(sources, horizon, stride, max(1, _STRETCHES // copies)):
        course = driver(scenes.without_intentions()) - scenes.positions[:, PRESENT, None]
        whole = scenes.present.all(dim=1)
        courses.append(course.transpose(2, 3)[:, whole].double().numpy())
    return np.concatenate(courses, axis=1)


def _stretches(sources: list[SceneSource], horizon: int, stride: int, chunk: int) -> Iterator[RolloutScenes]:
    for source in sources:
        rows = source.starts(horizon, stride)
        for at in range(0, len(rows), chunk):
            yield cut_stretches([(source, row) for row in rows[at : at + chunk]], horizon)


@torch.no_grad()
def calibrated_forecasts(
    generator: Generator,
    sources: list[SceneSource],
    horizon: int,
    stride: int,
    samples: int = SAMPLES,
    noise_period_s: float = 5.0,
    seed: int = 0,
    parameters: AnchorParameters = ANCHOR,
    traits: Traits = typical_traits,
) -> Forecasts:
    """The calibrated preset, rolled out through whole scenes; target lanes and traits look at the present alone."""
    random = torch.Generator().manual_seed(seed)

    def driver(scenes: RolloutScenes) -> Tensor:
        copies, shape = 1 + samples, scenes.length.shape
        headway, desired = (trait.repeat(copies, 1) for trait in traits(scenes))
        fresh = torch.randn(1 + horizon, copies, *shape, generator.sizes.noise, generator=random)
        fresh[:, 0] = 0.0
        noise = fresh.flatten(1, 2)
        many = scenes.repeated(copies)
        course = rollout(generator, many, headway, desired, noise[0], noise[1:], noise_period_s, parameters)
        return course.unflatten(0, (copies, shape[0]))

    courses = driven_courses(driver, sources, horizon, stride, 1 + samples)
    return summarised(courses, _recorded(sources, horizon, stride))


@torch.no_grad()
def idm_forecasts(sources: list[SceneSource], horizon: int, stride: int) -> Forecasts:
    """IDM along the road in whole scenes, the lateral position kept.

    ``idm``: everybody with Table V's headway and a desired speed of 22 m/s. ``idm_own_headway``: with the headway
    at which each driver is in balance at present, the calibrated preset's anchor.
    """
    forecasts = {}
    for name, traits in (("idm", common_traits), ("idm_own_headway", typical_traits)):
        driver = partial(_idm_courses, traits=traits)
        forecasts[name] = driven_courses(driver, sources, horizon, stride)[0]
    return forecasts


def _idm_courses(scenes: RolloutScenes, traits: Traits) -> Tensor:
    headway, desired = traits(scenes)
    road = scenes.road

    def move(vehicles: Vehicles, step: int) -> Vehicles:
        acceleration = following_acceleration(perceive(vehicles, road), TABLE_V, headway)
        velocity = displacement_of(vehicles)[..., 0] / PHYSICS_STEP_S + acceleration * PHYSICS_STEP_S
        return moved_by(vehicles, velocity, torch.zeros_like(velocity))

    return drive(scenes, desired, move)[None]


def _recorded(sources: list[SceneSource], horizon: int, stride: int) -> np.ndarray:
    def driver(scenes: RolloutScenes) -> Tensor:
        return scenes.future[None]

    return driven_courses(driver, sources, horizon, stride)[0]
