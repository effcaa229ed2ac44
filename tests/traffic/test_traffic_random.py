"""Drivers who differ: drawn once per episode, within their ranges, and obeyed by how they drive."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from reference.worlds import environment, same_bits, step, vehicles

from ganlane import keys
from ganlane.config.traffic import IdmRandomTrafficConfig
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.sim import Road, SpawnParameters, Vehicles, pair_overlaps
from ganlane.traffic import IdmMobilTraffic, IdmRandomTraffic, RandomDrivers
from ganlane.traffic.idm_mobil import DriverParams, start_braking

#: Everybody drives by Tables IV and V.
ALIKE = RandomDrivers((1.6, 1.6), (0.7, 0.7), (1.7, 1.7), (20.0, 20.0), (1, 1), (1, 1), (0, 0), (0, 0), (10, 10))


def params_of(td) -> DriverParams:
    return DriverParams(*td[keys.TRAFFIC, "traits"].unbind(-1))


def test_the_defaults_of_the_command_line_are_those_of_the_traffic():
    assert IdmRandomTrafficConfig().arguments() == {"drivers": RandomDrivers()}


def test_drivers_differ_and_lie_within_the_ranges():
    own, d = params_of(environment(num_envs=500, traffic=IdmRandomTraffic()).reset()), RandomDrivers()
    for value, (low, high) in (
        (own.headway, d.headway_s),
        (own.max_acceleration, d.max_acceleration),
        (own.comfortable_deceleration, d.comfortable_deceleration),
        (own.politeness, d.politeness),
        (own.sway, d.sway_m),
    ):
        assert low <= value.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < value.max() <= high
        assert value.mean().item() == pytest.approx((low + high) / 2, rel=0.05)
    assert sorted(own.delay.unique().tolist()) == [0, 1, 2, 3, 4, 5, 6]
    # Independent of each other.
    drawn = torch.stack([own.headway, own.max_acceleration, own.politeness, own.sway, own.delay]).flatten(1)
    assert (torch.corrcoef(drawn) - torch.eye(5)).abs().max() < 0.08


def test_desired_speeds_are_the_drivers_own_and_the_egos_is_not_touched():
    own = environment(num_envs=200, traffic=IdmRandomTraffic()).reset()[keys.VEHICLES, "desired_speed"]
    scene = environment(num_envs=200, traffic=IdmMobilTraffic()).reset()[keys.VEHICLES, "desired_speed"]
    factor = own / scene
    assert (factor[:, 0] == 1.0).all()
    assert 0.9 <= factor.min() < 0.91
    assert 1.09 < factor.max() <= 1.1


def test_a_driver_stays_the_same_through_an_episode_and_is_another_in_the_next():
    env = environment(num_envs=4, traffic=IdmRandomTraffic())
    first = env.reset()
    td = first
    for _ in range(10):
        td = step(env, td)
        assert torch.equal(td[keys.TRAFFIC, "traits"], first[keys.TRAFFIC, "traits"])
    asked = td.select(keys.SEED, keys.EPISODE)
    asked[keys.EPISODE] = asked[keys.EPISODE] + 4
    assert (env.reset(asked)[keys.TRAFFIC, "traits"][..., 0] != first[keys.TRAFFIC, "traits"][..., 0]).all()


@pytest.mark.parametrize("rows", [1, 7])
def test_an_episode_is_the_same_bits_in_every_batch(rows):
    wide, narrow = (environment(num_envs=n, traffic=IdmRandomTraffic(), dtype=torch.float32) for n in (64, rows))
    one, other = wide.reset(), narrow.reset()
    for _ in range(15):
        action = (one[keys.EPISODE] + one[keys.EGO, "decisions"]) % 5 % 3
        one, other = step(wide, one, action), step(narrow, other, action[:rows])
        assert same_bits(one[:rows], other) == []


def test_drivers_who_are_all_alike_drive_as_idm_mobil():
    one, other = (environment(num_envs=8, traffic=t) for t in (IdmMobilTraffic(), IdmRandomTraffic(drivers=ALIKE)))
    first, second = one.reset(), other.reset()
    for _ in range(20):
        first, second = step(one, first), step(other, second)
    for name in ("x", "y", "speed", "target_lane"):
        torch.testing.assert_close(first[keys.VEHICLES, name], second[keys.VEHICLES, name], atol=1e-9, rtol=1e-9)


def test_nobody_brakes_harder_than_it_can():
    env = environment(num_envs=64, traffic=IdmRandomTraffic())
    td, hardest = env.reset(), []
    limit = params_of(td).strongest_braking

    def record(now: Vehicles, running: torch.Tensor) -> None:
        assert (now.acceleration >= -limit - 1e-9)[:, 1:].all()
        hardest.append((now.acceleration + limit)[:, 1:].amin().item())

    env.recorder = record
    for _ in range(40):
        td = step(env, td, (td[keys.EPISODE] + td[keys.EGO, "decisions"]) % 4 % 3)
    # Some came to their limit.
    assert min(hardest) < 1e-6


def test_the_first_scene_asks_for_what_is_worked_out_by_hand():
    scene = vehicles(
        {"x": 100.0, "speed": 10.0}, {"x": 60.0, "speed": 20.0}, {"x": 30.0, "speed": 15.0}, {"x": 0.0, "lane": 1}
    )
    late = torch.tensor([[0.0, 0.5, 0.0, 0.0]], dtype=torch.float64)
    found = start_braking(scene, Road(), late)[0]
    # 35.5 m less 5 m of reaction; two ahead: 65.5 m less the 6.5 m of the one between.
    assert found.tolist() == pytest.approx([0.0, 100.0 / (2 * 30.5), 25.0 / (2 * 59.0), 0.0])


def test_a_reaction_time_delays_the_acceleration_by_as_much():
    scene = vehicles({"x": -500.0, "lane": 2}, {"x": 60.0, "speed": 10.0}, {"x": 0.0, "speed": 20.0})
    tracks = []
    for delay in (0.0, 0.4):
        traffic = IdmRandomTraffic(drivers=dataclasses.replace(ALIKE, reaction_s=(delay, delay)))
        env = environment(vehicles=3, traffic=traffic, period_s=0.1)
        td = env.reset()
        td[keys.VEHICLES].update(scene.as_dict())
        track = []
        for _ in range(6):
            td = step(env, td)
            track.append(td[keys.VEHICLES, "acceleration"][0, 2].item())
        tracks.append(track)
    assert tracks[0][0] < -1.0
    assert tracks[1][:4] == [0.0] * 4
    assert tracks[1][4] == pytest.approx(tracks[0][0])


@pytest.mark.parametrize(("lane_width_m", "bound"), [(4.0, 0.3), (3.0, 0.15)])
def test_a_driver_sways_within_its_lane(lane_width_m, bound):
    widest = dataclasses.replace(RandomDrivers(), sway_m=(0.3, 0.3))
    road = Road(lanes=3, lane_width_m=lane_width_m)
    env = HighwayEnv(IdmRandomTraffic(road, drivers=widest), 32, dtype=torch.float64)
    td, ways = env.reset(), []
    for _ in range(60):
        td = step(env, td)
        v = Vehicles.of(td[keys.VEHICLES])
        aimed = road.centre_of(v.target_lane, v.y.dtype)
        ways.append(torch.where((v.y - aimed).abs() < 0.5 * lane_width_m, v.y - aimed, 0.0)[:, 1:])
    way = torch.stack(ways)
    # Between lane changes; those under way are left out by taking the 90 % quantile.
    assert way.abs().flatten(1).quantile(0.9) <= bound + 0.05
    assert way.std(0).mean() > 0.2 * bound


def test_random_drivers_do_not_touch_each_other_in_500_vehicle_km_with_an_ego_that_keeps_its_lane():
    env, km, overlaps = HighwayEnv(IdmRandomTraffic(), 64, 14, SpawnParameters(spread_m=300.0)), 0.0, 0

    def record(now: Vehicles, running: torch.Tensor) -> None:
        nonlocal km, overlaps
        km += (now.speed * running[:, None])[:, 1:].sum().item() * 1e-4
        overlaps += pair_overlaps(now).any(-1).any(-1)[running].sum().item()

    env.recorder = record
    td = env.reset()
    while km < 500.0:
        td = step(env, td)
    assert overlaps == 0


def test_impossible_ranges_are_refused():
    for name, value in (("headway_s", [2.0, 1.0]), ("strongest_braking", [0.0, 5.0]), ("reaction_s", [0.0, 9.0])):
        with pytest.raises(UserError, match=f"^{name}"):
            IdmRandomTrafficConfig(**{name: value})
