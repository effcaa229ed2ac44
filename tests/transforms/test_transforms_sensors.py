"""Sensor errors reach what the agent sees of the others, and nothing else."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.refusals import user_error
from reference.worlds import (
    assert_same_tracks,
    environment,
    episode_keys,
    few_changes,
    run,
    same_bits,
    tracks,
    vehicles,
)
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

import ganlane
from ganlane import keys
from ganlane.settings.observation import SensorParameters
from ganlane.sim.random import Stream
from ganlane.transforms import ObservationTransform, RewardTransform, SensorTransform
from ganlane.transforms.sensors import measure

EVERYTHING = SensorParameters(1.0, 0.5, 2.0, dropout=0.2, delay_s=2.0)
#: Own speed and lanes, which no sensor error touches.
OWN = 3


def world(sensors, num_envs=3, goal_m=5000.0, period_s=1.0, form="table3", seed=11):
    """IDM-MOBIL traffic with these sensors; None: without the transform."""
    options = {"num_envs": num_envs, "period_s": period_s, "goal_m": goal_m, "seed": seed}
    base = environment(dtype=torch.float32, kernel="auto", **options)
    between = [] if sensors is None else [SensorTransform(sensors, base.stream, period_s)]
    seen = ObservationTransform(base.road, 9, form)
    return TransformedEnv(base, Compose(*between, seen, RewardTransform(period_s)))


def drive(env, decisions):
    """The states of a run without resets, and the rewards that led to them."""
    return run(env, decisions, few_changes)


def scene(rows, count):
    """``rows`` copies of a row of cars, 10 m from each other on the middle lane, at 20 m/s."""
    one = vehicles(*({"x": 10.0 * i, "lane": 1} for i in range(count)))
    return one.part([0] * rows)


def many(sensors):
    """The errors of many measurements of one scene.

    (along, across, speed) [5000, 5], and who is seen.
    """
    true = scene(5000, 5)
    seen = measure(true, episode_keys(range(5000)), torch.arange(5000) % 10, sensors)
    return (seen["x"] - true.x, seen["y"] - true.y, seen["speed"] - true.speed), seen["valid"]


NOISY = SensorParameters(position_noise_m=2.0, lateral_noise_m=0.5, speed_noise_mps=3.0)


def test_errors_are_gaussian_without_bias_and_of_the_size_asked_for():
    for error, deviation in zip(many(NOISY)[0], (2.0, 0.5, 3.0)):
        others = error[:, 1:] / deviation
        # Four standard errors of a mean, a standard deviation and a fourth moment.
        tolerance = 4 / math.sqrt(others.numel())
        assert others.mean().item() == pytest.approx(0.0, abs=tolerance)
        assert others.std().item() == pytest.approx(1.0, abs=tolerance / math.sqrt(2))
        assert (others**4).mean().item() == pytest.approx(3.0, abs=tolerance * math.sqrt(96))


def test_so_many_vehicles_drop_out_whatever_the_other_errors():
    for sensors in (SensorParameters(dropout=0.3), SensorParameters(1.0, 1.0, 1.0, dropout=0.3)):
        errors, seen = many(sensors)
        # Four standard deviations of a share of 20,000.
        assert (~seen[:, 1:]).double().mean().item() == pytest.approx(0.3, abs=0.013)
        assert all((error == 0).all() for error in errors) == (sensors.position_noise_m == 0)


def test_the_ego_knows_itself_without_error():
    errors, seen = many(EVERYTHING)
    assert not any(error[:, 0].any() for error in errors)
    assert seen[:, 0].all()


def test_nobody_is_seen_at_a_dropout_of_one_and_a_vehicle_that_is_not_there_never():
    env = world(SensorParameters(dropout=1.0))
    for td in drive(env, 3):
        assert (td["observation"][:, OWN:] == torch.tensor([1.0, 0.0, 0.0] * 8)).all()
        assert td[keys.VEHICLES, "valid"].all()
    absent = scene(4, 3)
    absent.valid[:, 1] = False
    noisy, lossy = (
        measure(absent, torch.arange(4), torch.zeros(4, dtype=torch.int64), sensors)["valid"]
        for sensors in (NOISY, SensorParameters(dropout=0.5))
    )
    assert torch.equal(noisy, absent.valid)
    assert not lossy[:, 1].any()


def test_perfect_sensors_show_the_present_observation_bit_for_bit():
    plain, perfect = (drive(world(sensors), 4) for sensors in (None, SensorParameters()))
    for one, other in zip(plain, perfect):
        assert same_bits(one, other.exclude("perceived")) == []


@settings(max_examples=10)
@given(
    st.floats(0, 5),
    st.floats(0, 3),
    st.floats(0, 5),
    st.floats(0, 1),
    st.integers(0, 3),
    st.integers(0, 2**40),
)
def test_the_true_state_reward_and_own_part_of_the_observation_are_untouched(
    along, across, speed, dropout, k, seed
):
    sensors = SensorParameters(along, across, speed, dropout, delay_s=float(k))
    for one, other in zip(*(drive(world(use, 2, seed=seed), 3) for use in (None, sensors))):
        bare = other.exclude("perceived", "sensors", "observation")
        assert same_bits(one.exclude("observation"), bare) == []
        assert torch.equal(one["observation"][:, :OWN], other["observation"][:, :OWN])
        assert (other["observation"][:, OWN:].abs() <= 1).all()


NOISE = {"position_noise_m": 1.0, "lateral_noise_m": 1.0, "speed_noise_mps": 1.0, "dropout": 0.1}


@pytest.mark.parametrize(
    ("form", "k", "errors"),
    [("table3", 1, {}), ("lane_view", 3, {}), ("table3_lane_view", 2, {}), ("table3", 2, NOISE)],
)
def test_a_delay_of_k_decisions_shows_the_others_as_they_were_measured_k_decisions_ago(
    form, k, errors
):
    """The noise belongs to the measurement, and comes as late as it."""
    prompt, late = (
        [td["observation"] for td in drive(world(SensorParameters(**use), form=form), 5)]
        for use in (errors, {**errors, "delay_s": float(k)})
    )
    others = slice(OWN, None if form == "table3" else -2)
    for number, observation in enumerate(late):
        # Until a measurement is old enough, the first one is delivered.
        assert torch.equal(observation[:, others], prompt[max(number - k, 0)][:, others])
        assert torch.equal(observation[:, :OWN], prompt[number][:, :OWN])
    assert not torch.equal(late[-1], prompt[-1])


def test_a_delay_may_be_any_multiple_of_the_decision_period():
    env = world(SensorParameters(delay_s=0.6), period_s=0.2)
    assert env.reset()["sensors", "x"].shape == (3, 3, 9)
    for delay_s, period_s in ((0.5, 1.0), (1.0, 0.3), (-1.0, 1.0)):
        with user_error(r"^delay_s=.*(multiple of the decision period|at least 0)"):
            SensorTransform(SensorParameters(delay_s=delay_s), 0, period_s)


def test_a_state_without_the_delayed_measurements_is_refused():
    td = world(None).reset()
    env = world(EVERYTHING)
    with user_error("start from a reset"):
        env.step(td.set("action", few_changes(td)))


def test_an_episode_is_seen_alike_in_any_batch_and_after_automatic_resets():
    in_32, in_5, alone = (
        tracks(world(EVERYTHING, rows, goal_m=140.0), decisions, few_changes)
        for rows, decisions in ((32, 12), (5, 20), (1, 26))
    )
    assert_same_tracks(in_5, in_32, at_least=7)
    assert_same_tracks(alone, in_32, at_least=2)


@pytest.mark.parametrize("sensors", [NOISY, EVERYTHING])
def test_the_specs_hold(sensors):
    check_env_specs(world(sensors), seed=0)


LATE = SensorParameters(delay_s=1.0, dropout=0.1)


@pytest.mark.parametrize(
    ("sensors", "first"), [(None, []), (SensorParameters(), []), (LATE, ["SensorTransform"])]
)
def test_a_transform_with_the_traffics_stream_is_inserted_where_there_are_errors(sensors, first):
    env = ganlane.make_env("idm", 2, stream="report", observation={"sensors": sensors})
    names = [type(transform).__name__ for transform in env.transform.transforms]
    assert names == [*first, "ObservationTransform", "RewardTransform"]
    if first:
        assert (env.transform[0].parameters, env.transform[0].stream) == (LATE, Stream.REPORT)


def test_a_delay_between_two_decisions_is_a_users_mistake():
    with user_error(r"^observation\.sensors\.delay_s=0\.5: expected a multiple of the decision"):
        ganlane.make_env(observation={"sensors": {"delay_s": 0.5}})
