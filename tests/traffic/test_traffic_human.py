"""``traffic=human``: decisions every 0.4 s, on the road and into nobody."""

import pytest
import torch
from reference.refusals import user_error
from reference.worlds import course, episode_keys, moves, vehicles_at

from ganlane import keys
from ganlane.api import make_env
from ganlane.generator import shipped_generator
from ganlane.generator.human import STEPS
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic
from ganlane.traffic.presets import human_traffic


def drive(rows, steps, dtype=torch.float32, **variation):
    """Vehicles and memory after each step of episodes 0 to ``rows`` - 1."""
    scene = RandomScenes()(episode_keys(range(rows)), dtype)
    return list(course(human_traffic(**variation), scene, steps))


def column(x, speed, desired_mps):
    """Cars at ``x`` [N, M] on the only lane."""
    return vehicles_at(
        x,
        torch.zeros(x.shape, dtype=torch.int64),
        speed=speed.expand_as(x),
        width=torch.full_like(x, 1.8),
        desired_speed=torch.full_like(x, desired_mps),
    )


def test_a_decision_holds_for_four_steps():
    states = drive(3, 8)
    held = torch.stack([memory["acceleration"] for _, memory in states])
    assert torch.equal(held[0], held[STEPS - 1])
    assert not torch.equal(held[STEPS - 1], held[STEPS])
    first, last = states[0][0], states[STEPS - 1][0]
    speed = last.speed * torch.cos(last.heading) - first.speed * torch.cos(first.heading)
    moving = last.speed > 1.0
    expected = held[0] * 0.1 * (STEPS - 1)
    assert torch.allclose(speed[moving], expected[moving], atol=1e-3)


def test_a_row_decides_at_its_own_time():
    """At steps 2, 4 and 5 of three rows one of them."""
    *_, (vehicles, memory) = drive(3, 2)
    clocks = torch.tensor([2, 4, 5])
    _, after = human_traffic().move(vehicles, dict(memory.items()), episode_keys([0, 1, 2]), clocks)
    assert (after["age"] == memory["age"]).all(1).tolist() == [True, False, True]


def test_half_a_minute_of_driving_has_no_collision_and_nobody_leaves_the_road():
    states = drive(16, 300)
    vehicles, _ = states[-1]
    assert vehicles.speed[:, 1:].min() > 5.0
    for vehicles, _ in states[::20]:
        assert vehicles.y.min() > -1.2
        assert vehicles.y.max() < 9.2
        assert not pair_overlaps(vehicles).any()


def test_it_drives_in_double_precision_and_on_one_lane():
    vehicles, _ = drive(1, 8, torch.float64)[-1]
    assert vehicles.x.dtype == torch.float64
    env = make_env("human", num_envs=2, env={"lanes": 1, "vehicles": 4})
    after = env.rollout(5)
    assert (after[keys.VEHICLES, "target_lane"][..., 1:] == 0).all()


def changes(rows, **variation):
    """Lane changes that are begun within 10 s."""
    states = drive(rows, 100, **variation)
    lanes = torch.stack([vehicles.target_lane for vehicles, _ in states])
    return int((lanes.diff(dim=0) != 0).sum())


def test_drivers_do_not_run_into_a_slow_car_far_ahead():
    """Recordings show no such approach, so the fit's simulation has to teach it."""
    places = 20.0 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    places += torch.tensor([0.0, -160.0, -220.0])
    start = column(places, torch.tensor([4.0, 22.0, 22.0]), 24.0)

    def slow_one_goes_on(before, after):
        """The first car drives 4 m/s whatever its driver wants."""
        return before.with_(x=before.x + 0.4).where((torch.arange(3) == 0).expand(100, 3), after)

    traffic = human_traffic(Road(1))
    struck = torch.zeros(100, dtype=torch.bool)
    for cars in moves(traffic, start, 300, slow_one_goes_on):
        struck |= pair_overlaps(cars).flatten(1).any(1)
    assert struck.float().mean() <= 0.02
    assert cars.speed[:, 1].median() < 5.0


def test_drivers_change_lanes_as_often_as_they_are_told():
    none, usual, more = (changes(32, lane_changes=factor) for factor in (0.0, 1.0, 8.0))
    assert none == 0
    assert 0 < usual < 0.5 * more


def test_who_is_behind_counts_the_less_the_less_polite_a_driver_is():
    assert changes(64, politeness=0.0) > changes(64, politeness=4.0)


@pytest.mark.slow
def test_a_stop_and_go_wave_forms_on_a_ring_where_idm_drivers_flow_on():
    """22 cars on a ring, as in Sugiyama et al. 2008 (230 m), here of 300 m."""
    road = Road(1, ring_m=300.0)
    noise = 0.3 * torch.randn(4, 22, generator=torch.Generator().manual_seed(0))
    even = column(torch.arange(22) * 300.0 / 22 + noise, torch.tensor(4.0), 15.0)
    *_, wave = moves(human_traffic(road), even, 1000)
    *_, flow = moves(IdmTraffic(road), even, 1000)
    # Somebody nearly stands while others go on.
    assert wave.speed.min(1).values.mean() < 1.0
    assert wave.speed.max(1).values.mean() > 6.0
    assert flow.speed.std(1).mean() < 0.1 * wave.speed.std(1).mean()


def test_foreign_weights_are_refused():
    with user_error("human"):
        human_traffic(path=shipped_generator("calibrated"))
