"""Rule-based drivers of the ego."""

import torch

from ganlane.agents.drivers import RandomDriver, RandomLegalDriver
from ganlane.env import HighwayEnv
from ganlane.keys import KEEP, LEFT, RIGHT
from ganlane.sim import Road
from ganlane.traffic import IdmTraffic


def driven(kind, rows):
    """The first lanes of so many episodes, and the actions of a driver there."""
    state = HighwayEnv(IdmTraffic(), num_envs=rows, vehicles=9).reset()
    return state["vehicles", "target_lane"][:, 0], kind(Road())(state)["action"]


def test_random_drivers_use_all_actions_equally():
    _, action = driven(RandomDriver, 9000)
    shares = torch.bincount(action, minlength=3) / 9000
    assert (shares - 1 / 3).abs().max() < 0.02  # four standard deviations of a share of a third


def test_the_legal_random_driver_never_asks_for_a_lane_that_is_not_there():
    lane, action = driven(RandomLegalDriver, 6000)
    for current, legal in ((0, [KEEP, LEFT]), (1, [KEEP, LEFT, RIGHT]), (2, [KEEP, RIGHT])):
        shares = torch.bincount(action[lane == current], minlength=3) / (lane == current).sum()
        assert shares.nonzero()[:, 0].tolist() == legal
        assert (shares[legal] - 1 / len(legal)).abs().max() < 0.06


def test_random_actions_depend_on_the_episode_and_not_on_the_batch():
    (_, few), (_, many) = (driven(RandomDriver, rows) for rows in (4, 64))
    assert torch.equal(few, many[:4])
