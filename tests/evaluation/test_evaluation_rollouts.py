"""Recorded episodes can be driven again, and what a crash hit."""

import pytest
from reference.worlds import vehicles

from ganlane.agents.drivers import KeepLaneDriver
from ganlane.build import make_env, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig
from ganlane.errors import UserError
from ganlane.evaluation import replay, roll_out, run_episodes
from ganlane.evaluation.episodes import SIDES, contact_side, ego_at_fault
from ganlane.sim.state import Road


def test_a_rollout_is_the_evaluated_episode_and_comes_back_from_its_actions():
    config = EnvConfig(goal_m=90.0)
    env = make_env(make_traffic(IdmMobilTrafficConfig(), config), config, num_envs=2)
    policy = KeepLaneDriver(env.base_env.road)
    rollouts = roll_out(env, policy, [4, 1, 7], seed=3)
    table = run_episodes(env, policy, [4, 1, 7], seed=3)
    assert [each.end for each in rollouts] == table["reason"].to_list()
    assert [len(each.actions) for each in rollouts] == table["decisions"].to_list()
    assert [each.reward for each in rollouts] == pytest.approx(table["reward"].to_list(), rel=1e-5)
    assert replay(env, {each.episode: each.actions for each in rollouts}, seed=3) == sorted(
        rollouts, key=lambda each: each.episode
    )
    assert replay(env, {}, seed=3) == []
    with pytest.raises(UserError, match="episodes: none were asked for"):
        roll_out(env, policy, [], seed=3)


@pytest.mark.parametrize(
    ("other", "side"),
    [
        ({"x": 4.4, "speed": 10.0}, "ahead"),
        ({"x": -4.4, "speed": 30.0}, "behind"),
        ({"y": 2.4, "heading": -0.1}, "side"),
        ({"x": 4.0, "y": 2.2, "heading": -0.1}, "side"),
        ({"x": -4.2, "y": 1.0, "speed": 30.0, "heading": 0.1}, "behind"),
        ({"x": 10.0}, "none"),
    ],
)
def test_where_the_ego_was_hit(other, side):
    scene = vehicles({"x": 0.0, "y": 0.0, "target_lane": 0}, {"x": 0.0, "y": 0.0, "target_lane": 0, **other})
    assert SIDES[int(contact_side(scene, Road()))] == side


@pytest.mark.parametrize(
    ("ego", "other", "at_fault"),
    [
        ({"speed": 20.0}, {"x": 4.4, "speed": 10.0}, True),  # into the one ahead
        ({}, {"x": -4.4, "speed": 30.0}, False),  # struck from behind
        ({}, {"y": 2.4, "heading": -0.1}, False),  # the other changes lanes into the ego
        ({"heading": 0.1}, {"y": 2.4}, True),  # the ego into the other
        ({"heading": 0.1}, {"y": 2.4, "heading": -0.05}, True),  # both, the ego faster
        ({"heading": -0.05}, {"y": -2.4, "heading": 0.1}, False),  # both, the other faster
        ({"speed": 30.0}, {"x": 10.0}, False),  # nobody was hit
    ],
)
def test_who_moved_into_whom(ego, other, at_fault):
    same = {"x": 0.0, "y": 0.0, "target_lane": 0}
    assert bool(ego_at_fault(vehicles({**same, **ego}, {**same, **other}))) == at_fault
