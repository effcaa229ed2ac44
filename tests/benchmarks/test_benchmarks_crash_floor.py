"""A driver who knows what comes finds the way out if there is one, and what it finds can be driven
again.
"""

import itertools

import pytest
import torch
from torchrl.envs import TransformedEnv

from benchmarks.beam_search import beam_search
from benchmarks.crash_floor import driver_row, floor_rows, search_left, ways_of_drivers
from ganlane.agents.drivers import KeepLaneDriver
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.errors import UserError
from ganlane.evaluation import clopper_pearson, replay, roll_out
from ganlane.keys import KEEP, LEFT, RIGHT
from ganlane.settings.episode import SpawnParameters
from ganlane.sim.random import Stream
from ganlane.sim.scenes import FixedScene, SceneVehicle
from ganlane.sim.state import Road
from ganlane.traffic import IdmTraffic, TrafficModule
from ganlane.transforms import RewardTransform

#: Ego at 20 m/s, which wants no more; somebody who never brakes comes from behind; the lane to the
#: right is taken.
CHASED = (
    SceneVehicle(0.0, 1, 20.0, 20.0),
    SceneVehicle(-35.0, 1, 30.0),
    SceneVehicle(0.0, 0, 20.0, length_m=60.0),
)
#: Too fast to stop before a car that stands ahead, and lorries on both sides.
LORRIES = [SceneVehicle(0.0, lane, 30.0, length_m=120.0) for lane in (0, 2)]
TRAPPED = SceneVehicle(0.0, 1, 30.0), SceneVehicle(25.0, 1, 0.0), *LORRIES


class Cruise(TrafficModule):
    """Straight on at a constant speed, whatever comes."""

    def move(self, vehicles, memory, key, step):
        return vehicles.with_(x=vehicles.x + vehicles.speed * self.dt), memory


class Hopeless(FixedScene):
    """A scene that is not checked for a way out."""

    def check(self, road, idm):
        """Anything goes."""


def highway(scene=None, rows=4, goal_m=300.0, traffic=Cruise, **others):
    scenes, episode = (
        None if scene is None else Hopeless(scene),
        EpisodeParameters(goal_m=goal_m, timeout_s=60.0),
    )
    model = traffic(Road(), Stream.REPORT)
    base = HighwayEnv(model, num_envs=rows, scenes=scenes, episode=episode, **others)
    return TransformedEnv(base, RewardTransform())


def crowded(rows, goal_m=120.0):
    """Random scenes with little room, in which nobody makes any."""
    return highway(None, rows, goal_m, spawn_parameters=SpawnParameters(spread_m=120.0), vehicles=9)


def test_who_is_chased_escapes_into_the_free_lane_and_only_there():
    env = highway(CHASED)
    (plan,) = beam_search(env, [0], seed=0, beam=4)
    assert plan.found
    assert plan.actions[0] == LEFT
    (ride,) = replay(env, {0: plan.actions}, seed=0)
    assert (ride.end, ride.actions, ride.reward) == ("goal", plan.actions, plan.reward)
    (kept,) = roll_out(env, KeepLaneDriver(env.base_env.road), [0], seed=0)
    assert (kept.end, kept.contact, kept.changing) == ("hard_crash", "behind", False)
    (right,) = replay(env, {0: [RIGHT]}, seed=0)
    assert (right.end, right.changing) == ("hard_crash", True)


def test_who_is_trapped_crashes_whatever_it_does():
    env = highway(TRAPPED)
    ends = replay(env, dict(enumerate([[KEEP], [LEFT], [RIGHT], [KEEP, LEFT]])), seed=0)
    assert [ride.end for ride in ends] == ["hard_crash"] * 4
    assert ends[0].contact == "ahead"
    (plan,) = beam_search(env, [7], seed=0, beam=64)
    assert (plan.episode, plan.found) == (7, False)
    (ride,) = replay(env, {7: plan.actions}, seed=0)
    assert (ride.end, ride.actions) == ("hard_crash", plan.actions)
    assert plan.widest < 64, "nothing but like states was dropped"


def test_the_search_finds_a_way_where_trying_everything_does():
    episodes, seed = range(12), 3
    env = crowded(3**5, goal_m=90.0)
    possible = [somebody_comes_through(env, episode, seed) for episode in episodes]
    plans = beam_search(crowded(16, goal_m=90.0), episodes, seed, beam=32)
    assert [plan.found for plan in plans] == possible
    assert 0 < sum(possible) < len(episodes), "the scenes are of both kinds"


def somebody_comes_through(env, episode, seed):
    """Whether any of all sequences of five actions does, each in a row of its own."""
    sequences = torch.tensor(list(itertools.product((KEEP, LEFT, RIGHT), repeat=5)))
    start = env.reset().select("seed", "episode")
    start["seed"][:], start["episode"][:] = seed, episode
    state = env.reset(start)
    running = torch.ones(len(sequences)).bool()
    for decision in itertools.count():
        state["action"] = (
            sequences[:, decision] if decision < 5 else torch.zeros_like(sequences[:, 0])
        )
        state = env.step(state)["next"].exclude("reward", "action")
        if (running & state["events", "goal"][:, 0]).any():
            return True
        running &= ~state["done"][:, 0]
        if not running.any():
            return False


@pytest.mark.parametrize("by_reward", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_answer_depends_neither_on_the_rows_nor_on_the_company(by_reward):
    episodes = list(range(12))
    plans = beam_search(crowded(16), episodes, 1, 4, by_reward)
    assert {plan.found for plan in plans} == {True, False}
    assert max(plan.widest for plan in plans) == 4
    for rows, asked in ((5, episodes[::-1]), (64, episodes), (7, [5, 11])):
        again = beam_search(crowded(rows), asked, 1, 4, by_reward)
        assert again == [plans[number] for number in asked]


def test_every_way_that_was_found_is_driven_again_to_the_same_end_and_earns_no_less_than_keeping_the_lane():
    env = crowded(8)
    plans = beam_search(env, range(12), 1, 8)
    rides = replay(env, {plan.episode: plan.actions for plan in plans}, 1)
    assert [ride.safe for ride in rides] == [plan.found for plan in plans]
    assert [ride.reward for ride in rides] == pytest.approx([plan.reward for plan in plans])
    env = highway(None, 16, 400.0, IdmTraffic, vehicles=9)
    best = beam_search(env, range(4), 0, 4, by_reward=True)
    kept = roll_out(env, KeepLaneDriver(env.base_env.road), range(4), 0)
    assert all(plan.reward >= ride.reward - 1e-3 for plan, ride in zip(best, kept, strict=True))


def test_the_floor_lies_under_every_driver_and_falls_with_the_beam():
    env, episodes = crowded(16), range(20)
    kept = roll_out(env, KeepLaneDriver(env.base_env.road), episodes, 1)
    ways = ways_of_drivers([kept], episodes)
    for beam in (1, 16):
        ways = search_left(env, ways, 1, beam)
    rows = floor_rows(ways, [1, 16])
    left = [row["not_avoided"] for row in rows]
    assert left[0] == sum(not ride.safe for ride in kept)
    assert left[0] > left[2] > 0
    assert left == sorted(left, reverse=True)
    exact = clopper_pearson(left[-1], 20)
    assert (rows[-1]["share"], rows[-1]["share_ci"]) == (exact.value, exact.interval)
    for way in ways:
        assert way.ride.safe == (way.stage is not None)
        assert (way.ride.end == "hard_crash") == (way.stage is None)
    row = driver_row("keep_lane", kept, ways)
    assert row["hard_crash"] == row["ahead"] + row["side"] + row["behind"] == left[0]
    assert row["avoidable"] == left[0] - left[-1]
    assert row["keeping_lane"] == row["hard_crash"]


def test_without_drivers_every_episode_is_searched_with_a_beam_and_automatic_resets_are_left_alone():
    env = highway(CHASED)
    ways = search_left(env, ways_of_drivers([], [0, 1]), 0, 4)
    assert [way.stage for way in ways] == ["beam 4", "beam 4"]
    env.base_env.last_episodes = (torch.zeros(4).long(), torch.tensor([4, 5, 6, 7]))
    beam_search(env, [100, 200], 0, 2)
    assert env.base_env.last_episodes[1].tolist() == [4, 5, 6, 7]
    with pytest.raises(UserError, match="beam=0"):
        beam_search(env, [0], 0, 0)
