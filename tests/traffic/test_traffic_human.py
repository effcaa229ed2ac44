"""``traffic=human``: decisions every 0.4 s, the same for an episode wherever it is driven."""

import pytest
import torch
from reference.worlds import vehicles_at

from ganlane import keys
from ganlane.api import make_env
from ganlane.errors import UserError
from ganlane.generator import shipped_generator
from ganlane.generator.human import STEPS
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.random import episode_key
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic
from ganlane.traffic.presets import human_traffic


def course(traffic, vehicles, key, steps):
    """Vehicles and memory after every step."""
    memory = traffic.fresh_memory(vehicles, key)
    for step in range(steps):
        vehicles, memory = traffic.move(vehicles, memory, key, torch.full_like(key, step))
        yield vehicles, memory


def keys_of(traffic, episodes):
    episode = torch.tensor(episodes)
    return episode_key(traffic.stream, torch.zeros_like(episode), episode)


def drive(episodes, steps, dtype=torch.float32, **variation):
    traffic = human_traffic(**variation)
    key = keys_of(traffic, episodes)
    return list(course(traffic, RandomScenes()(key, dtype), key, steps))


def test_a_decision_holds_for_four_steps():
    course = drive([0, 1, 2], 8)
    held = torch.stack([memory["acceleration"] for _, memory in course])
    assert torch.equal(held[0], held[STEPS - 1])
    assert not torch.equal(held[STEPS - 1], held[STEPS])
    first, last = course[0][0], course[STEPS - 1][0]
    speed = last.speed * torch.cos(last.heading) - first.speed * torch.cos(first.heading)
    moving = last.speed > 1.0
    expected = held[0] * 0.1 * (STEPS - 1)
    assert torch.allclose(speed[moving], expected[moving], atol=1e-3)


def test_an_episode_is_the_same_among_others_and_in_rows_that_decide_at_other_times():
    together, alone = drive([0, 1, 2], 40), drive([1], 40)
    for (many, _), (one, _) in zip(together, alone):
        assert torch.allclose(many.x[1], one.x[0], atol=1e-3)
        assert torch.equal(many.target_lane[1], one.target_lane[0])
    traffic = human_traffic()
    vehicles, memory = together[1]
    key = keys_of(traffic, [0, 1, 2])
    # Rows at steps 2, 4 and 5: one of them decides.
    _, after = traffic.move(vehicles, memory, key, torch.tensor([2, 4, 5]))
    same = [torch.equal(after["age"][row], memory["age"][row]) for row in range(3)]
    assert same == [True, False, True]


def test_half_a_minute_of_driving_has_no_collision_and_nobody_leaves_the_road():
    course = drive(range(16), 300)
    vehicles, _ = course[-1]
    assert vehicles.speed[:, 1:].min() > 5.0
    for vehicles, _ in course[::20]:
        assert vehicles.y.min() > -1.2
        assert vehicles.y.max() < 9.2
        assert not pair_overlaps(vehicles).any()


def test_it_drives_in_double_precision_and_on_one_lane():
    vehicles, _ = drive([0], 8, torch.float64)[-1]
    assert vehicles.x.dtype == torch.float64
    env = make_env("human", num_envs=2, env={"lanes": 1, "vehicles": 4})
    after = env.rollout(5)
    assert (after[keys.VEHICLES, "target_lane"][..., 1:] == 0).all()


def changes(course):
    """Lane changes that were begun."""
    lanes = torch.stack([vehicles.target_lane for vehicles, _ in course])
    return int((lanes[1:] != lanes[:-1]).sum())


def test_drivers_do_not_run_into_a_slow_car_far_ahead():
    """Recordings show no such approach, so the fit's simulation has to teach it."""
    road, rows = Road(1, 4.0), 100
    places = torch.tensor([[0.0, -160.0, -220.0]]).repeat(rows, 1)
    traffic = human_traffic(road)
    key = keys_of(traffic, range(rows))
    cars = vehicles_at(
        places + 20.0 * torch.rand(rows, 3, generator=torch.Generator().manual_seed(0)),
        torch.zeros(rows, 3, dtype=torch.int64),
        speed=torch.tensor([[4.0, 22.0, 22.0]]).repeat(rows, 1),
        width=torch.full((rows, 3), 1.8),
        desired_speed=torch.full((rows, 3), 24.0),
    )
    memory = traffic.fresh_memory(cars, key)
    struck = torch.zeros(rows, dtype=torch.bool)
    slow = torch.tensor([True, False, False])
    for step in range(300):
        moved, memory = traffic.move(cars, memory, key, torch.full_like(key, step))
        # The first car goes on at 4 m/s whatever its driver wants.
        ahead = cars.with_(x=cars.x + 0.4)
        cars = ahead.where(slow.expand(rows, 3), moved)
        struck |= pair_overlaps(cars).flatten(1).any(1)
    assert struck.float().mean() <= 0.02
    assert cars.speed[:, 1].median() < 5.0


def test_drivers_change_lanes_as_often_as_they_are_told():
    none, usual, more = (
        changes(drive(range(32), 100, lane_changes=factor)) for factor in (0.0, 1.0, 8.0)
    )
    assert none == 0
    assert 0 < usual < 0.5 * more


def test_who_is_behind_counts_the_less_the_less_polite_a_driver_is():
    assert changes(drive(range(64), 100, politeness=0.0)) > changes(
        drive(range(64), 100, politeness=4.0)
    )


@pytest.mark.slow
def test_a_stop_and_go_wave_forms_on_a_ring_where_idm_drivers_flow_on():
    """22 cars on a ring, as in Sugiyama et al. 2008 (230 m), here of 300 m."""
    road = Road(1, 4.0, ring_m=300.0)
    rows, cars = 4, 22
    noise = 0.3 * torch.randn(rows, cars, generator=torch.Generator().manual_seed(0))
    even = vehicles_at(
        torch.arange(cars) * road.ring_m / cars + noise,
        torch.zeros(rows, cars, dtype=torch.int64),
        speed=torch.full((rows, cars), 4.0),
        width=torch.full((rows, cars), 1.8),
        desired_speed=torch.full((rows, cars), 15.0),
    )
    wave, flow = (
        list(course(traffic, even, keys_of(traffic, range(rows)), 1000))[-1][0]
        for traffic in (human_traffic(road), IdmTraffic(road))
    )
    # Somebody nearly stands while others go on.
    assert wave.speed.min(1).values.mean() < 1.0
    assert wave.speed.max(1).values.mean() > 6.0
    assert flow.speed.std(1).mean() < 0.1 * wave.speed.std(1).mean()


def test_foreign_weights_are_refused():
    with pytest.raises(UserError, match="human"):
        human_traffic(path=shipped_generator("calibrated"))
