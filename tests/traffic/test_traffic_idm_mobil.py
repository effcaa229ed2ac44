"""Rule-driven traffic whose drivers differ: within their ranges, and obeyed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from reference.foreign import overlaps_of_the_others, start
from reference.worlds import DOUBLE, environment, placed, step, vehicles

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.settings.driving import RandomDrivers
from ganlane.settings.traffic import IdmRandomTrafficConfig
from ganlane.sim import Road, SpawnParameters, Vehicles
from ganlane.traffic import IdmMobilTraffic, IdmRandomTraffic
from ganlane.traffic.idm_mobil import DriverParams, start_braking

#: Everybody drives by Tables IV and V.
ALIKE = RandomDrivers(
    (1.6, 1.6), (0.7, 0.7), (1.7, 1.7), (20.0, 20.0), (1, 1), (1, 1), (0, 0), (0, 0), (10, 10)
)


def params_of(td) -> DriverParams:
    return DriverParams(*td[keys.TRAFFIC, "traits"].unbind(-1))


@pytest.mark.parametrize(
    ("name", "value"),
    [("headway_s", [2.0, 1.0]), ("strongest_braking", [0.0, 5.0]), ("reaction_s", [0.0, 9.0])],
)
def test_impossible_ranges_are_refused(name, value):
    with pytest.raises(UserError, match=f"^{name}"):
        IdmRandomTrafficConfig(**{name: value})


def test_drivers_differ_and_lie_within_the_ranges():
    drivers = params_of(environment(num_envs=500, traffic=IdmRandomTraffic()).reset())
    d = RandomDrivers()
    for value, (low, high) in (
        (drivers.headway, d.headway_s),
        (drivers.max_acceleration, d.max_acceleration),
        (drivers.comfortable_deceleration, d.comfortable_deceleration),
        (drivers.politeness, d.politeness),
        (drivers.sway, d.sway_m),
    ):
        assert low <= value.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < value.max() <= high
        assert value.mean().item() == pytest.approx((low + high) / 2, rel=0.05)
    assert sorted(drivers.delay.unique().tolist()) == [0, 1, 2, 3, 4, 5, 6]
    # Independent of each other.
    drawn = torch.stack(
        [drivers.headway, drivers.max_acceleration, drivers.politeness, drivers.sway, drivers.delay]
    ).flatten(1)
    assert (torch.corrcoef(drawn) - torch.eye(5)).abs().max() < 0.08


def test_desired_speeds_are_the_drivers_own_and_the_egos_is_not_touched():
    theirs, scene = (
        environment(num_envs=200, traffic=traffic).reset()[keys.VEHICLES, "desired_speed"]
        for traffic in (IdmRandomTraffic(), IdmMobilTraffic())
    )
    factor = theirs / scene
    assert (factor[:, 0] == 1.0).all()
    assert 0.9 <= factor.min() < 0.91
    assert 1.09 < factor.max() <= 1.1


def test_a_driver_stays_the_same_through_an_episode_and_is_another_in_the_next():
    env = environment(num_envs=4, traffic=IdmRandomTraffic())
    td = first = env.reset()
    for _ in range(3):
        td = step(env, td)
        assert torch.equal(td[keys.TRAFFIC, "traits"], first[keys.TRAFFIC, "traits"])
    others = start(env, range(4, 8))[keys.TRAFFIC, "traits"]
    assert (others[..., 0] != first[keys.TRAFFIC, "traits"][..., 0]).all()


def test_drivers_who_are_all_alike_drive_as_idm_mobil():
    one, other = (
        environment(num_envs=8, traffic=t)
        for t in (IdmMobilTraffic(), IdmRandomTraffic(drivers=ALIKE))
    )
    first, second = one.reset(), other.reset()
    for _ in range(8):
        first, second = step(one, first), step(other, second)
    for name in ("x", "y", "speed", "target_lane"):
        torch.testing.assert_close(
            first[keys.VEHICLES, name], second[keys.VEHICLES, name], atol=1e-9, rtol=1e-9
        )


def test_nobody_brakes_harder_than_it_can():
    env = environment(num_envs=192, traffic=IdmRandomTraffic())
    td = env.reset()
    margins = []
    limit = params_of(td).strongest_braking
    env.recorder = lambda now, running: margins.append(
        (now.acceleration + limit)[:, 1:].amin().item()
    )
    for _ in range(12):
        td = step(env, td, (td[keys.EPISODE] + td[keys.EGO, "decisions"]) % 4 % 3)
    # Some came to their limit.
    assert -1e-9 <= min(margins) < 1e-6


def test_the_first_scene_asks_for_what_is_worked_out_by_hand():
    scene = vehicles(
        {"x": 100.0, "speed": 10.0},
        {"x": 60.0, "speed": 20.0},
        {"x": 30.0, "speed": 15.0},
        {"x": 0.0, "lane": 1},
    )
    braking = start_braking(scene, Road(), torch.tensor([[0.0, 0.5, 0.0, 0.0]], dtype=DOUBLE))[0]
    # 35.5 m less 5 m of reaction; two ahead: 65.5 m less the 6.5 m of the one between.
    assert braking.tolist() == pytest.approx([0.0, 100.0 / (2 * 30.5), 25.0 / (2 * 59.0), 0.0])


def test_a_reaction_time_delays_the_acceleration_by_as_much():
    scene = vehicles(
        {"x": -500.0, "lane": 2}, {"x": 60.0, "speed": 10.0}, {"x": 0.0, "speed": 20.0}
    )
    prompt = []
    late = []
    for track, delay in ((prompt, 0.0), (late, 0.4)):
        traffic = IdmRandomTraffic(drivers=replace(ALIKE, reaction_s=(delay, delay)))
        env = environment(vehicles=3, traffic=traffic, period_s=0.1)
        td = placed(env, scene)
        for _ in range(6):
            td = step(env, td)
            track.append(td[keys.VEHICLES, "acceleration"][0, 2].item())
    assert prompt[0] < -1.0
    assert late[:4] == [0.0] * 4
    assert late[4] == pytest.approx(prompt[0])


@pytest.mark.parametrize(("lane_width_m", "bound"), [(4.0, 0.3), (3.0, 0.15)])
def test_a_driver_sways_within_its_lane(lane_width_m, bound):
    road = Road(lanes=3, lane_width_m=lane_width_m)
    widest = replace(RandomDrivers(), sway_m=(0.3, 0.3))
    env = HighwayEnv(IdmRandomTraffic(road, drivers=widest), 24, dtype=torch.float64)
    td = env.reset()
    ways = []
    for _ in range(12):
        td = step(env, td)
        v = Vehicles.of(td[keys.VEHICLES])
        off = v.y - road.centre_of(v.target_lane, v.y.dtype)
        ways.append(torch.where(off.abs() < 0.5 * lane_width_m, off, 0.0)[:, 1:])
    way = torch.stack(ways)
    # Between lane changes; those under way are left out by taking the 90 % quantile.
    assert way.abs().flatten(1).quantile(0.9) <= bound + 0.05
    assert way.std(0).mean() > 0.2 * bound


def test_random_drivers_do_not_touch_each_other_in_500_vehicle_km_with_an_ego_that_keeps_its_lane():
    env = HighwayEnv(IdmRandomTraffic(), 64, 14, SpawnParameters(spread_m=300.0), kernel="auto")
    assert overlaps_of_the_others(env, 500.0, ego=True) == 0
