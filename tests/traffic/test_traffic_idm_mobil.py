"""Rule-driven traffic whose drivers differ: within their ranges, and obeyed."""

from dataclasses import replace

import pytest
import torch
from reference.refusals import user_error
from reference.traffics import start
from reference.worlds import DOUBLE, environment, few_changes, placed, run, vehicles

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.settings.driving import RandomDrivers
from ganlane.settings.traffic import IdmRandomTrafficConfig
from ganlane.sim import Road
from ganlane.traffic import IdmMobilTraffic, IdmRandomTraffic
from ganlane.traffic.idm_mobil import DriverParams, start_braking

#: Everybody drives by Tables IV and V.
ALIKE = RandomDrivers(
    (1.6, 1.6), (0.7, 0.7), (1.7, 1.7), (20.0, 20.0), (1, 1), (1, 1), (0, 0), (0, 0), (10, 10)
)


def params_of(td):
    return DriverParams(*td[keys.TRAFFIC, "traits"].unbind(-1))


@pytest.mark.parametrize(
    ("name", "value"),
    [("headway_s", [2.0, 1.0]), ("strongest_braking", [0.0, 5.0]), ("reaction_s", [0.0, 9.0])],
)
def test_impossible_ranges_are_refused(name, value):
    with user_error(f"^{name}"):
        IdmRandomTrafficConfig(**{name: value})


def test_drivers_differ_and_lie_within_the_ranges():
    drivers = params_of(environment(num_envs=500, traffic=IdmRandomTraffic()).reset())
    d = RandomDrivers()
    ranges = {
        "headway": d.headway_s,
        "max_acceleration": d.max_acceleration,
        "comfortable_deceleration": d.comfortable_deceleration,
        "politeness": d.politeness,
        "sway": d.sway_m,
    }
    for name, (low, high) in ranges.items():
        value = getattr(drivers, name)
        assert low <= value.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < value.max() <= high
        assert value.mean().item() == pytest.approx((low + high) / 2, rel=0.05)
    assert sorted(drivers.delay.unique().tolist()) == [0, 1, 2, 3, 4, 5, 6]
    # Independent of each other.
    drawn = torch.stack([getattr(drivers, name).flatten() for name in (*ranges, "delay")])
    assert (torch.corrcoef(drawn) - torch.eye(6)).abs().max() < 0.08


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
    first, *later = (td[keys.TRAFFIC, "traits"] for td in run(env, 3))
    assert all(torch.equal(traits, first) for traits in later)
    others = start(env, range(4, 8))[keys.TRAFFIC, "traits"]
    assert (others[..., 0] != first[..., 0]).all()


def test_drivers_who_are_all_alike_drive_as_idm_mobil():
    ends = []
    for traffic in (IdmMobilTraffic(), IdmRandomTraffic(drivers=ALIKE)):
        *_, td = run(environment(num_envs=8, traffic=traffic), 8)
        ends.append(dict(td[keys.VEHICLES].select("x", "y", "speed", "target_lane")))
    torch.testing.assert_close(*ends, atol=1e-9, rtol=1e-9)


def test_nobody_brakes_harder_than_it_can():
    env = environment(num_envs=192, traffic=IdmRandomTraffic())
    margins = []
    limit = params_of(env.reset()).strongest_braking
    env.recorder = lambda now, running: margins.append(
        (now.acceleration + limit)[:, 1:].amin().item()
    )
    run(env, 12, few_changes)
    # Some came to their limit.
    assert -1e-9 <= min(margins) < 1e-6


def test_the_first_scene_asks_for_what_is_worked_out_by_hand():
    cars = ({"x": x, "speed": speed} for x, speed in ((100.0, 10.0), (60.0, 20.0), (30.0, 15.0)))
    scene = vehicles(*cars, {"x": 0.0, "lane": 1})
    braking = start_braking(scene, Road(), torch.tensor([[0.0, 0.5, 0.0, 0.0]], dtype=DOUBLE))[0]
    # 35.5 m less 5 m of reaction; two ahead: 65.5 m less the 6.5 m of the one between.
    assert braking.tolist() == pytest.approx([0.0, 100.0 / (2 * 30.5), 25.0 / (2 * 59.0), 0.0])


def test_a_reaction_time_delays_the_acceleration_by_as_much():
    scene = vehicles(
        {"x": -500.0, "lane": 2}, {"x": 60.0, "speed": 10.0}, {"x": 0.0, "speed": 20.0}
    )
    asked = []
    for delay, steps in ((0.0, 1), (0.4, 5)):
        traffic = IdmRandomTraffic(drivers=replace(ALIKE, reaction_s=(delay, delay)))
        env = environment(vehicles=3, traffic=traffic, period_s=0.1)
        _, *states = run(env, steps, start=placed(env, scene))
        asked += [td[keys.VEHICLES, "acceleration"][0, 2].item() for td in states]
    prompt, *waits, late = asked
    assert prompt < -1.0
    assert waits == [0.0] * 4
    assert late == pytest.approx(prompt)


@pytest.mark.parametrize(("lane_width_m", "bound"), [(4.0, 0.3), (3.0, 0.15)])
def test_a_driver_sways_within_its_lane(lane_width_m, bound):
    road = Road(lanes=3, lane_width_m=lane_width_m)
    widest = replace(RandomDrivers(), sway_m=(0.3, 0.3))
    env = HighwayEnv(IdmRandomTraffic(road, drivers=widest), 24, dtype=torch.float64)
    ways = []
    for td in run(env, 12):
        off = td[keys.VEHICLES, "y"] - lane_width_m * td[keys.VEHICLES, "target_lane"]
        ways.append(torch.where(off.abs() < 0.5 * lane_width_m, off, 0.0)[:, 1:])
    way = torch.stack(ways)
    # Between lane changes; those under way are left out by taking the 90 % quantile.
    assert way.abs().flatten(1).quantile(0.9) <= bound + 0.05
    assert way.std(0).mean() > 0.2 * bound
