"""SUMO's drivers around our ego."""

import pytest
import torch
from reference.refusals import user_error

pytest.importorskip("libsumo", reason="SUMO is not installed: pip install 'ganlane[sumo]'")

from reference.traffics import drive, start
from reference.worlds import step

from ganlane import keys
from ganlane.agents.drivers import DRIVERS
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.evaluation import run_episodes
from ganlane.settings.driving import Visibility
from ganlane.sim.scenes import FixedScene, SceneVehicle
from ganlane.sim.state import Road, body_lanes
from ganlane_simulators import SumoTraffic

LEFT = 1


@pytest.fixture(scope="module")
def traffic():
    return SumoTraffic()


def test_nobody_jumps_and_speeds_are_differences_of_positions(traffic):
    vehicles, _, _ = drive(HighwayEnv(traffic, 6), range(6), 40)
    dx, dy = (field[1:] - field[:-1] for field in (vehicles.x, vehicles.y))
    mean = 0.5 * (vehicles.speed[1:] + vehicles.speed[:-1])
    # A car that comes to a stand within a step stops at once: 0.6 m/s at most, which it then has
    # not driven.
    assert (dx - 0.1 * mean)[..., 1:].abs().max() < 0.03
    assert dy[..., 1:].abs().max() < 0.11, "4 m in 4 s"
    acceleration = (vehicles.speed[1:] - vehicles.speed[:-1]) / 0.1
    torch.testing.assert_close(
        vehicles.acceleration[1:, :, 1:], acceleration[..., 1:], rtol=0.0, atol=1e-3
    )
    assert vehicles.acceleration.amin() > -9.1
    assert vehicles.heading.abs().max() <= 0.2


def follower_of(traffic, lane_of_ego, action):
    """Speeds of a fast driver 30 m behind a slow ego's place in lane 1, over 6 s."""
    # Somebody ahead keeps out of the ego's way, far enough away for the driver behind not to mind.
    cars = ((0.0, lane_of_ego, 12.0, 12.0), (-32.0, 1, 20.0, 20.0), (2000.0, 2, 20.0, 20.0))
    rows = tuple(SceneVehicle(*car) for car in cars)
    first = FixedScene(rows, Road(), others_visibility=Visibility.BODY)
    env = HighwayEnv(traffic, 1, scenes=first)
    command = torch.tensor([action])
    driven, running, _ = drive(env, [0], 6, lambda td: command * (td[keys.STEP] == 0))
    assert running.all()
    return driven


def test_a_follower_brakes_for_an_ego_that_moves_in_front_and_only_then():
    keeps = SumoTraffic(speed_wander=0.0)
    free = follower_of(keeps, 0, 0)
    cut_off = follower_of(keeps, 0, LEFT)
    assert free.speed[:, 0, 1].amin() > 19.0
    ego = cut_off.at(0).columns(slice(1))
    enters = int((body_lanes(ego, Road()).high[:, 0] > 0).nonzero()[0])
    # The stand-in comes in at the start of the step at whose end the ego's body does.
    assert torch.equal(free.speed[:enters, 0, 1], cut_off.speed[:enters, 0, 1])
    assert cut_off.speed[enters, 0, 1] < 20.0
    assert cut_off.speed[:, 0, 1].amin() < 17.0 or cut_off.y[-1, 0, 1] > 6.0


def test_vehicles_that_return_in_front_of_the_ego_are_followed(traffic):
    env = HighwayEnv(traffic, 4, recycle=True)
    vehicles, running, _ = drive(env, range(4), 60)
    away = (vehicles.x[1:] - vehicles.x[:-1] - 0.1 * vehicles.speed[1:])[..., 1:].abs() > 100.0
    assert away.any()
    assert running.all(), "somebody crashed"
    assert ((vehicles.x - vehicles.x[..., :1]).abs() < 500.0).all()


def test_a_state_that_sumo_did_not_leave_is_refused(traffic):
    env = HighwayEnv(traffic, 1)
    first = step(env, start(env, [0]))
    second = step(env, first)
    step(env, second)
    with user_error("not the one that SUMO left"):
        step(env, first)


def test_two_environments_cannot_take_turns_but_may_follow_each_other():
    one = HighwayEnv(SumoTraffic(), 1)
    other = HighwayEnv(SumoTraffic(), 1)
    first = step(one, start(one, [0]))
    step(other, start(other, [0]))
    with user_error("a process has one SUMO"):
        step(one, first)
    step(one, start(one, [0]))


def test_episodes_that_take_the_rows_of_others_are_evaluated_as_in_a_batch_of_their_own(traffic):
    keep = DRIVERS["keep_lane"](Road())
    short = EpisodeParameters(goal_m=300.0)
    one, other = (
        run_episodes(HighwayEnv(traffic, rows, episode=short), keep, range(4), 0) for rows in (4, 2)
    )
    assert one.equals(other)
