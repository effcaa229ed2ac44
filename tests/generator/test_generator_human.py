"""The policy of ``human``: what a driver perceives and does, its samples, fit and fine-tuning."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from reference.recordings import made_by_hand, recorded_cars
from reference.worlds import vehicles

from ganlane.config.run import run_command
from ganlane.generator import (
    human_estimator,
    human_fit,
    human_tuning,
    load_human,
    shipped_generator,
)
from ganlane.generator.human import (
    ACROSS,
    ALONG,
    FEATURES,
    HARDEST_BRAKING,
    HumanPolicy,
    Situation,
    bounded,
    chosen,
    features_of,
    lane_choice,
    moved,
    perceive,
    velocity,
    with_choice,
)
from ganlane.generator.human_estimator import other_noise
from ganlane.generator.human_fit import (
    fit_human,
    fit_steps,
    prior_acceleration,
    prior_samples,
)
from ganlane.generator.human_samples import (
    LATERAL_GAIN,
    Options,
    cuts,
    samples_of,
    segments_of,
    smooth_scene,
    target_lanes,
)
from ganlane.generator.human_tuning import Strangers, costs, entering_memory
from ganlane.settings.generator import SIDE_FEATURES, HumanConfig, HumanSizes
from ganlane.sim.state import Road

ROAD = Road(3, 4.0)
CAR = {"lane": 1, "width": 2.0}


def scene(*cars):
    return vehicles(*({**CAR, **car} for car in cars), dtype=torch.float32)


def situation(cars):
    memory = entering_memory(cars, ROAD, torch.zeros_like(cars.x))
    return Situation(cars, memory, ROAD, perceive(cars, ROAD))


def policy():
    torch.manual_seed(0)
    return HumanPolicy(HumanSizes(hidden=16, lane_hidden=8)).requires_grad_(False)


def test_a_soft_target_is_around_its_value_and_samples_follow_the_distribution():
    value = torch.tensor([-1.3, 0.0, 0.4])
    target = ALONG.soft_target(value)
    assert torch.allclose((target * ALONG.centres(value)).sum(-1), value, atol=0.05)
    logits = target.log()[2]
    u = (torch.arange(4000) + 0.5) / 4000
    drawn = ALONG.sample(logits.expand(4000, -1), u)
    assert (drawn.diff() >= 0).all()
    # A token stretches over more for large changes, so the mean is a little larger.
    assert float(drawn.mean()) == pytest.approx(float(ALONG.mean(logits)), abs=0.02)
    colder = ALONG.sample(logits.expand(4000, -1), u, temperature=0.5)
    assert colder.std() < drawn.std()


def test_a_driver_sees_the_gap_to_its_leader_and_nobody_in_an_empty_lane():
    cars = scene({}, {"x": 34.5, "speed": 15.0}, {"x": -30.0, "lane": 2})
    view = perceive(cars, ROAD)
    assert features_of(situation(cars)).shape == (1, 3, FEATURES)
    assert float(view.gap[0, 0]) == pytest.approx(30.0)
    assert float(view.closing[0, 0]) == pytest.approx(-5.0)
    assert float(view.log_headway[0, 0]) == pytest.approx(np.log(30.0 / 20.0), abs=1e-5)
    # The first in a lane follows nobody.
    assert view.log_headway[0, 1].isnan()
    assert float(view.gap[0, 1]) == 150.0
    assert view.exists[0].tolist() == [[True, True], [True, True], [False, True]]
    alone = perceive(cars, ROAD, sides=False)
    assert not alone.exists.any()


def test_left_and_right_are_alike():
    cars = scene({}, {"x": 20.0, "lane": 2, "speed": 17.0}, {"x": -15.0, "lane": 0})
    mirrored = scene({}, {"x": 20.0, "lane": 0, "speed": 17.0}, {"x": -15.0, "lane": 2})
    here, there = (lane_choice(situation(road_users)).sides for road_users in (cars, mirrored))
    assert torch.equal(here[:, 0], there[:, 0].flip(1))


def test_chances_add_up_nobody_changes_to_where_no_lane_is_and_a_change_can_be_broken_off():
    cars = scene({"lane": 2}, {"lane": 0, "x": 50.0}, {"x": 100.0, "lane": 1, "target_lane": 2})
    now = situation(cars)
    chances = policy().lane_chances(lane_choice(now))
    assert torch.allclose(chances.sum(-1), torch.ones(1, 3), atol=1e-5)
    left, right = chances[0, :, 1], chances[0, :, 2]
    # Under way to the left, there is only going on and breaking off.
    assert max(left[0], right[1], right[2]) < 1e-6
    low, high = (chosen(chances, torch.full((1, 3), u)) for u in (0.0, 0.999999))
    assert low[0, 2] == 1
    after_low, after_high = (
        with_choice(now, choice).vehicles.target_lane[0].tolist() for choice in (low, high)
    )
    assert after_low[1:] == [1, 1]
    assert after_high[0] == 1


def test_nobody_rolls_back_brakes_harder_than_a_car_or_steers_off_the_road():
    cars = scene({"speed": 1.0}, {"lane": 2, "x": 50.0}, {"y": -1.5, "lane": 0, "x": 100.0})
    wild = torch.tensor([[-20.0, -20.0, 0.0]]), torch.tensor([[0.0, 5.0, 0.0]])
    acceleration, aside = bounded(situation(cars), *wild)
    assert float(acceleration[0, 0]) == pytest.approx(-2.5)
    assert float(acceleration[0, 1]) == HARDEST_BRAKING
    # 10 m less the lane's centre, half a body and a margin, in 0.8 s.
    assert float(aside[0, 1]) == pytest.approx((10.0 - 8.0 - 1.15) / 0.8, abs=1e-5)
    # Whose body reaches beyond the edge comes back.
    assert float(aside[0, 2]) == pytest.approx(0.65 / 0.8, abs=1e-5)
    after = moved(cars, acceleration, aside)
    assert (velocity(after)[0] >= 0).all()


def test_a_lane_change_is_meant_from_where_the_driver_sets_out():
    # 2 s in lane 0, 3 s over to lane 1, 2 s there.
    over = np.linspace(0.0, 3.5, 31)
    y = np.concatenate([np.zeros(20), over, np.full(20, 3.5)])
    target = target_lanes(y, np.gradient(y, 0.1), 3.5, 2)
    begin = int(np.flatnonzero(np.diff(target))[0]) + 1
    # The first 0.3 m count as swaying.
    assert 20 < begin <= 24
    assert set(target[:begin]) == {0}
    assert set(target[begin:]) == {1}
    # A track that touches the next lane for a moment has no change.
    touched = np.zeros(40)
    touched[20:22] = 2.0
    assert set(np.delete(target_lanes(touched, np.zeros(40), 3.5, 2), [20, 21])) == {0}


def steady_samples(*driver, **options):
    """Of two cars at 20 m/s, one 40 m behind the other, in the middle of three lanes."""
    x = 2.0 * np.arange(140)[:, None] + np.array([0.0, 40.0])
    stretches = cuts([smooth_scene(made_by_hand(x, y=3.5), HumanConfig())], 10, 10)
    options = Options(*driver, vary=False, blind=0.0, **options)
    return samples_of(stretches, options, torch.Generator().manual_seed(0))


def test_teacher_samples_of_steady_driving_ask_for_no_change():
    moves, choices = steady_samples()
    assert len(moves.features) > 20
    assert moves.change.abs().max() < 1e-3
    assert moves.aside.abs().max() < 1e-3
    assert not (choices.begins == 1).any()


def staying(features, across_token=ACROSS.number // 2):
    """A policy that changes nothing."""
    along = torch.zeros(*features.shape[:-1], ALONG.number)
    across = torch.zeros(*features.shape[:-1], ACROSS.number)
    along[..., ALONG.number // 2] = across[..., across_token] = 50.0
    return along, across


def test_in_the_closed_loop_a_driver_lives_with_its_own_moves_and_is_led_back():
    # A policy that always goes to the left as fast as it can.
    drifting = partial(staying, across_token=-1)
    moves = steady_samples(drifting, samples=1).moves
    # At the first decisions it is as recorded, later it has to come back to its lane.
    assert moves.aside.max().abs() < 1e-3
    assert (moves.aside < -0.5).float().mean() > 0.5


def test_the_drivers_of_a_closed_loop_begin_where_the_estimate_sees_them():
    """Here half a metre to the left of where they were recorded, from where they are led back."""

    def beside(positions):
        motion = torch.zeros(*positions.shape[:-2], 7)
        motion[..., 0] = 20.0
        motion[..., 6] = 0.5
        return motion

    moves = steady_samples(staying, estimator=beside, samples=1).moves
    assert float(moves.aside.min()) == pytest.approx(-0.5 * LATERAL_GAIN, abs=0.03)


def test_strangers_take_their_pace_stop_behind_others_and_push_in_where_there_is_room():
    cars = scene({"lane": 1, "target_lane": 0}, {"x": -30.0, "speed": 25.0}, {"lane": 2})
    pace = torch.tensor([[5.0, 25.0, 25.0]])
    strangers = Strangers(torch.ones(1, 3, dtype=torch.bool), pace, torch.full((1, 3), 3.0))
    acceleration, aside = strangers.moves(cars, ROAD)
    # One brakes to its pace no harder than it wants to, one as hard as it must, one speeds up.
    assert acceleration[0, 0] == -3.0
    assert acceleration[0, 1] < -1.0
    assert acceleration[0, 2] > 0.0
    # On its way to the lane on the right.
    assert aside[0, 0] < -0.5
    assert aside[0, 2] == 0.0

    here = scene({"lane": 1}, {"lane": 2, "x": 2.0}, {"lane": 0, "x": 60.0})
    choice = lane_choice(situation(here))
    wish, left, right = torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1, 3)
    # Somebody is beside it on the left; on the right there is room.
    assert strangers.choices(choice, wish, left)[0, 0] == 0
    assert strangers.choices(choice, wish, right)[0, 0] == 2
    assert strangers.choices(choice, wish + 1.0, right)[0, 0] == 0


def test_nobody_learns_from_what_strangers_do():
    random = torch.Generator().manual_seed(0)
    critic = torch.nn.Linear(FEATURES + 2 * SIDE_FEATURES, 1)
    decisions = human_tuning.drive(policy(), critic, random)
    share = decisions.valid[0].float().mean()
    expected = 1.0 - human_tuning.STRANGERS * human_tuning.WITH_STRANGERS
    assert share == pytest.approx(expected, abs=0.03)


def test_accidents_the_edge_and_standing_cost():
    apart = scene({}, {"x": 60.0})
    free = torch.full((1, 2), 150.0)
    cost, hit = costs(apart, ROAD, free)
    assert cost.max() < 0.01
    assert not hit.any()
    cost, hit = costs(scene({}, {"x": 4.0, "speed": 15.0}), ROAD, free)
    assert hit.all()
    # The one behind is to blame.
    assert cost[0, 0] > cost[0, 1] + 4.0
    cost, _ = costs(scene({"lane": 0, "y": -1.2}), ROAD, free[:, :1])
    assert cost > 3.0
    cost, _ = costs(scene({"speed": 1.0}), ROAD, free[:, :1])
    assert cost > 0.3


def test_the_noise_of_a_sensor_that_nobody_knows_is_not_taken_for_braking():
    """At 25 m/s; to those that had seen one camera alone it was 24 m/s2 at worst."""
    steady = torch.zeros(500, 9, 2)
    steady[..., 0] = 2.5 * torch.arange(9.0)
    noise = other_noise(500, 9, torch.Generator().manual_seed(0))
    model, _ = load_human(shipped_generator("human"))
    speed, acceleration = model.estimator(steady + noise)[..., :2].unbind(-1)
    assert (speed - 25.0).abs().median() < 0.5
    assert acceleration.abs().max() < 2.0


def test_traffic_that_is_faster_keeps_its_gaps_and_accelerations():
    recordings = recorded_cars(scenes=1, vehicles=5, seconds=8.0)
    scenes = [smooth_scene(recording, HumanConfig()) for recording in recordings]
    segments = segments_of(cuts(scenes, decisions=4, stride=10))
    faster = segments.faster(torch.full((len(segments.x), 1), 10.0))

    there = segments.present
    assert faster.speed[there] == pytest.approx(segments.speed[there] + 10.0)
    assert torch.equal(faster.x[~there], segments.x[~there])
    # Two vehicles are as far from each other at every time, and the noise is the same.
    both = there[..., 0] & there[..., 1]
    before = segments.x[..., 1] - segments.x[..., 0]
    after = faster.x[..., 1] - faster.x[..., 0]
    assert after[both] == pytest.approx(before[both], abs=1e-3)
    assert faster.raw_x - faster.x == pytest.approx(segments.raw_x - segments.x, abs=1e-3)
    # The way of a second is ten metres longer.
    second = there[:, :-10] & there[:, 10:]
    longer = (faster.x - segments.x)[:, 10:] - (faster.x - segments.x)[:, :-10]
    assert longer[second] == pytest.approx(10.0, abs=1e-2)


def follower_asks(gap, speed, leader, desired=40.0, headway=1.5):
    """What a driver of the prior asks for, m/s2."""
    cars = scene({"speed": speed}, {"x": gap + 4.5, "speed": leader})
    cars = cars.with_(desired_speed=torch.full_like(cars.x, desired))
    return float(prior_acceleration(cars, ROAD, torch.full((1, 2), headway))[0, 0])


def test_drivers_of_the_prior_keep_their_headway_and_respond_the_less_the_farther_the_leader():
    assert follower_asks(45.0, 30.0, 30.0) == pytest.approx(0.0, abs=1e-6)
    assert follower_asks(60.0, 30.0, 30.0) > 0.0 > follower_asks(30.0, 30.0, 30.0)
    # 2 m/s slower than the leader: 0.1 times that at 45 m, half as much at twice the gap.
    assert follower_asks(45.0, 30.0, 32.0) == pytest.approx(0.2, abs=1e-6)
    assert follower_asks(90.0, 30.0, 32.0, headway=3.0) == pytest.approx(0.1, abs=1e-6)
    # Nobody speeds up beyond what it wishes, and danger is answered as IDM does.
    assert follower_asks(60.0, 30.0, 32.0, desired=30.0) == pytest.approx(0.0, abs=1e-6)
    assert follower_asks(20.0, 30.0, 15.0) < -5.0


def test_where_recordings_are_silent_the_prior_brakes_and_keeps_out_of_danger():
    moves, danger = prior_samples(torch.Generator().manual_seed(0), scenes=300)
    assert moves.features.isfinite().all()
    assert len(danger) > 100
    assert moves.change.min() < -4.0


SMALL = {"epochs": 1, "rounds": 1, "tuning": 1, "settling": 1, "samples": 2, "observing": 1}


@pytest.fixture
def small_fits(monkeypatch):
    """Fits that take half a second."""
    monkeypatch.setattr(human_estimator, "UPDATES", 5)
    monkeypatch.setattr(human_fit, "prior_samples", partial(prior_samples, scenes=100))
    monkeypatch.setattr(human_fit, "LANE_UPDATES", 5)
    monkeypatch.setattr(human_fit, "LONG_DECISIONS", 5)
    monkeypatch.setattr(human_tuning, "SCENES", 4)
    monkeypatch.setattr(human_tuning, "DECISIONS", 3)


def test_a_fit_is_the_same_for_the_same_seed_and_reports_its_steps(small_fits):
    recordings = recorded_cars(scenes=2, vehicles=5, seconds=5.0)
    config = HumanConfig(sizes=HumanSizes(hidden=16, lane_hidden=8), **SMALL)
    costs_of_steps = []
    state = torch.get_rng_state()
    first = fit_human(config, recordings, report=costs_of_steps.append)
    second = fit_human(config, recordings)
    assert torch.equal(torch.get_rng_state(), state)
    assert len(costs_of_steps) == fit_steps(config) == 5
    # Fine-tuning alone has a cost.
    assert [cost is None for cost in costs_of_steps] == [True, True, False, False, False]
    for one, other in zip(first.state_dict().values(), second.state_dict().values()):
        assert torch.equal(one, other)
    assert all(tensor.isfinite().all() for tensor in first.state_dict().values())


def test_the_command_fits_folds_keeps_what_is_finished_and_its_weights_load(
    small_fits, recordings, monkeypatch
):
    options = [f"generator.{name}={value}" for name, value in SMALL.items()]
    arguments = ["generator=human", recordings, *options]
    assert run_command("train_generator", [*arguments, "folds=2", "hydra.run.dir=fit"]) == 0
    results = json.loads(Path("fit/results.json").read_text())
    assert {"mean", "single", "best_of_20", "constant_velocity"} < results["ade_m"].keys()
    assert "rollout" in results["folds"]
    model, metadata = load_human("fit/generator_human.safetensors")
    assert metadata["data"]["held_out"] == results["data"]["held_out"]
    # What is finished is not fitted again.
    monkeypatch.setattr("ganlane.generator.tasks.fit_human", None)
    assert run_command("train_generator", [*arguments, "resume=fit", "hydra.run.dir=again"]) == 0
    again, _ = load_human("again/generator_human.safetensors")
    assert torch.equal(model.policy.along.weight, again.policy.along.weight)
