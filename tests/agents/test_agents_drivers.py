"""Rule-based drivers of the ego."""

import torch

from ganlane.agents.drivers import RandomDriver, RandomLegalDriver
from ganlane.env import HighwayEnv
from ganlane.keys import KEEP, LEFT, RIGHT
from ganlane.sim import Road
from ganlane.traffic import IdmTraffic


def states(n=256, lanes=3, m=9):
    return HighwayEnv(IdmTraffic(Road(lanes)), num_envs=n, vehicles=m).reset()


def test_random_drivers_use_all_actions_equally():
    action = RandomDriver(Road())(states(9000))["action"]
    shares = torch.bincount(action, minlength=3) / 9000
    assert (shares - 1 / 3).abs().max() < 0.02  # four standard deviations of a share of a third


def test_the_legal_random_driver_never_asks_for_a_lane_that_is_not_there():
    state = states(6000)
    lane = state["vehicles", "target_lane"][:, 0]
    action = RandomLegalDriver(Road())(state)["action"]
    assert not ((lane == 2) & (action == LEFT)).any()
    assert not ((lane == 0) & (action == RIGHT)).any()
    for current, legal in ((0, (KEEP, LEFT)), (1, (KEEP, LEFT, RIGHT)), (2, (KEEP, RIGHT))):
        shares = torch.bincount(action[lane == current], minlength=3) / (lane == current).sum()
        assert all(abs(shares[a] - 1 / len(legal)) < 0.06 for a in legal)


def test_random_actions_depend_on_the_episode_and_not_on_the_batch():
    few = states(4)
    many = states(64)
    driver = RandomDriver(Road())
    assert torch.equal(driver(few)["action"], driver(many)["action"][:4])
