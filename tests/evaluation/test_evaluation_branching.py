"""Branching a state: what each first action would have led to."""

import torch
from torchrl.envs import Compose, TransformedEnv

from ganlane.agents.drivers import KeepLaneDriver
from ganlane.env import HighwayEnv
from ganlane.evaluation import branch
from ganlane.keys import KEEP, LEFT, RIGHT
from ganlane.traffic import IdmTraffic, TrafficModule
from ganlane.transforms import RewardTransform


class Cruise(TrafficModule):
    """Straight on at a constant speed, whatever comes."""

    def move(self, vehicles, memory, key, step):
        return vehicles.with_(x=vehicles.x + vehicles.speed * self.dt), memory


def highway(n, m=9, traffic=IdmTraffic):
    return TransformedEnv(HighwayEnv(traffic(), num_envs=n, vehicles=m), Compose(RewardTransform()))


def scene(env, x, lanes, speeds):
    """All rows at the same hand-made scene, the ego first."""
    state = env.reset()
    vehicles = state["vehicles"]
    vehicles["x"][:] = torch.tensor(x)
    vehicles["target_lane"][:] = torch.tensor(lanes)
    vehicles["y"][:] = torch.tensor(lanes) * 4.0
    vehicles["speed"][:] = torch.tensor(speeds)
    vehicles["desired_speed"][:] = torch.tensor([25.0, *speeds[1:]])
    return state


def test_overtaking_a_slow_leader_pays_and_leaving_the_road_does_not():
    env = highway(1, m=2)
    state = scene(env, [0.0, 40.0], [0, 0], [15.0, 10.0])
    outcome = branch(env, state, KeepLaneDriver(env.base_env.road), decisions=30)
    returns = outcome.returns[:, 0]
    assert returns[LEFT] > returns[KEEP] + 5.0
    assert returns[RIGHT] == -100.0
    assert outcome.advantage()[0] == returns[LEFT] - returns[KEEP]


def test_a_change_into_a_car_that_never_brakes_is_a_crash_in_that_branch_alone():
    env = highway(1, m=2, traffic=Cruise)
    state = scene(env, [0.0, -4.0], [1, 2], [15.0, 16.0])
    crashed = branch(env, state, KeepLaneDriver(env.base_env.road), decisions=10).crashed[:, 0]
    assert crashed.tolist() == [False, True, False]


def test_branching_leaves_the_state_alone_and_agrees_with_driving_on():
    env = highway(4)
    state, driver = env.reset(), KeepLaneDriver(env.base_env.road)
    before = state.clone()
    outcome = branch(env, state, driver, decisions=5, gamma=0.9)
    assert (state == before).all()
    total, at = torch.zeros(4, 1), state
    for number in range(5):
        step, at = env.step_and_maybe_reset(driver(at))
        total += 0.9**number * step["next", "reward"]
    torch.testing.assert_close(outcome.returns[KEEP], total[:, 0])


def test_an_episode_that_has_ended_earns_nothing_more():
    env = highway(2)
    state = env.reset()
    state["done"][1] = True
    outcome = branch(env, state, KeepLaneDriver(env.base_env.road), decisions=3)
    assert (outcome.returns[:, 0] != 0).all()
    assert (outcome.returns[:, 1] == 0).all()


def test_automatic_resets_go_on_from_the_environment_not_from_the_branches():
    env = highway(2)
    env.base_env.last_episodes = (torch.zeros(2).long(), torch.tensor([4, 5]))
    elsewhere = env.reset(env.base_env.reset().select("seed", "episode").set("episode", torch.tensor([100, 200])))
    env.base_env.last_episodes = (torch.zeros(2).long(), torch.tensor([4, 5]))
    branch(env, elsewhere, KeepLaneDriver(env.base_env.road), decisions=2)
    assert env.base_env.last_episodes[1].tolist() == [4, 5]
