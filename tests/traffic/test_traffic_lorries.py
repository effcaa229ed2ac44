"""Traffic with lorries does not run into itself, nor into an ego that keeps its lane."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference.worlds import vehicles

from ganlane import keys
from ganlane.agents.drivers import KeepLaneDriver
from ganlane.build import make_env, make_traffic
from ganlane.generator.closed_loop import extra_inputs
from ganlane.realism.long_runs import LongRunParameters
from ganlane.realism.starts import spawned_recordings
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import (
    GanCalibratedTrafficConfig,
    IdmMobilTrafficConfig,
    IdmTrafficConfig,
)
from ganlane.sim import Road, SpawnParameters, Vehicles, pair_overlaps, perceive
from ganlane.traffic import IdmTraffic


def drive(traffic, rows: int, decisions: int, recycle: bool) -> tuple[float, float, int, int]:
    """Vehicle-km, those of lorries, steps in which two bodies overlap, and hard crashes, with a
    keep-lane ego.
    """
    config = EnvConfig(truck_share=0.4, recycle=recycle)
    env = make_env(make_traffic(traffic, config), config, num_envs=rows)
    km = lorries = 0.0
    overlaps = crashes = 0

    def record(vehicles: Vehicles, running: torch.Tensor) -> None:
        nonlocal km, lorries, overlaps
        driven = vehicles.speed * (vehicles.valid & running[:, None]) * keys.PHYSICS_STEP_S / 1000.0
        km += driven.sum().item()
        lorries += driven[vehicles.length == 12.0].sum().item()
        overlaps += int(pair_overlaps(vehicles)[running].sum()) // 2

    env.base_env.recorder = record
    state = env.reset()
    driver = KeepLaneDriver(env.base_env.road)
    with torch.no_grad():
        for _ in range(decisions):
            step, state = env.step_and_maybe_reset(driver(state))
            crashes += int(step["next", keys.EVENTS, "hard_crash"].sum())
    return km, lorries, overlaps, crashes


@pytest.mark.parametrize(
    ("traffic", "rows", "recycle"),
    [
        (IdmTrafficConfig(), 32, False),
        (IdmMobilTrafficConfig(), 32, True),
        (GanCalibratedTrafficConfig(), 8, False),
    ],
    ids=["idm", "idm_mobil", "gan_calibrated"],
)
def test_nobody_overlaps_a_lorry(traffic, rows, recycle):
    km, lorries, overlaps, crashes = drive(traffic, rows, 40, recycle)
    assert km > 0.5 * rows * 9 * 0.015 * 40
    three_sigma = 3.0 * (0.4 * 0.6 / (8 * rows)) ** 0.5  # of the share among so many vehicles
    assert lorries == pytest.approx(km * 0.4 * 8 / 9, rel=three_sigma / 0.4)
    assert (overlaps, crashes) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("traffic", "rows", "seconds", "least_km"),
    [
        (IdmTrafficConfig(), 64, 150, 1760),
        (IdmMobilTrafficConfig(), 64, 150, 1800),
        (GanCalibratedTrafficConfig(), 48, 100, 840),
    ],
    ids=["idm", "idm_mobil", "gan_calibrated"],
)
def test_nobody_overlaps_a_lorry_on_a_road_that_stays_full(traffic, rows, seconds, least_km):
    km, _, overlaps, crashes = drive(traffic, rows, seconds, True)
    assert km > least_km
    assert (overlaps, crashes) == (0, 0)


def test_the_generator_is_told_the_gap_behind_the_lorry():
    """Centres 30 m apart, 21.75 m free; the input is gap / (gap + 20)."""
    scene = vehicles({"x": 0.0}, {"x": 30.0, "length": 12.0})
    zero = torch.zeros(1, 2)
    seen = extra_inputs(perceive(scene, Road()), zero, zero)
    assert seen[0, 0, 1].item() == pytest.approx(21.75 / 41.75)


def test_the_realism_card_measures_spawned_lorries_by_their_own_length():
    parameters = LongRunParameters(9, most_s=2.0, spawn=SpawnParameters(truck_share=0.5))
    recordings = spawned_recordings(IdmTraffic, Road(), parameters, rows=4)
    lengths = np.concatenate([recording.length for recording in recordings])
    assert set(lengths) == {4.5, 12.0}
    assert 0.2 < np.mean(lengths == 12.0) < 0.8
