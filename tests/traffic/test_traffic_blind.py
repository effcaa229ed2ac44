"""Blind episodes: the others do not see the ego, the environment does."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import environment, same_bits, step, vehicles
from scipy.stats import binomtest

from ganlane import keys
from ganlane.build import make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig, IdmTrafficConfig
from ganlane.errors import UserError
from ganlane.traffic import BlindTraffic, IdmMobilTraffic, IdmTraffic, MixedTraffic
from ganlane.traffic.presets import gan_traffic, idm_faults_traffic

CHASE = vehicles({"x": 0.0, "speed": 10.0, "desired_speed": 10.0}, {"x": -60.0, "speed": 25.0, "desired_speed": 25.0})


def chased(share: float) -> tuple[list[float], bool]:
    """Speeds of a fast driver behind a slow ego, second by second, and whether they crashed."""
    env = environment(vehicles=2, traffic=BlindTraffic(IdmTraffic(), share))
    td = env.reset()
    td[keys.VEHICLES].update(CHASE.as_dict())
    speeds, crash = [], False
    for _ in range(8):
        td = step(env, td)
        speeds.append(td[keys.VEHICLES, "speed"][0, 1].item())
        crash = crash or bool(td[keys.EVENTS, "hard_crash"])
    return speeds, crash


def test_a_follower_brakes_for_an_ego_that_it_sees():
    speeds, crash = chased(0.0)
    assert min(speeds) < 15.0
    assert not crash


def test_a_follower_drives_into_an_ego_that_it_does_not_see_and_the_environment_says_so():
    speeds, crash = chased(1.0)
    assert min(speeds) > 24.9
    assert crash


@pytest.mark.parametrize("traffic", [IdmMobilTraffic, idm_faults_traffic])
def test_nobody_is_blind_at_a_share_of_0_and_nothing_is_built(traffic):
    plain, blind = (environment(num_envs=16, traffic=made) for made in (traffic(), BlindTraffic(traffic(), 0.0)))
    one, other = plain.reset(), blind.reset()
    for _ in range(10):
        one, other = step(plain, one), step(blind, other)
        assert same_bits(one.exclude(keys.TRAFFIC), other.exclude(keys.TRAFFIC)) == []
        assert same_bits(one[keys.TRAFFIC], other[keys.TRAFFIC, "model"]) == []
    assert isinstance(make_traffic(IdmMobilTrafficConfig(), EnvConfig()), IdmMobilTraffic)
    assert isinstance(make_traffic(IdmTrafficConfig(blind_share=0.5), EnvConfig()), BlindTraffic)


def test_the_ego_stays_where_the_environment_has_it():
    env = environment(num_envs=8, traffic=BlindTraffic(IdmMobilTraffic(), 1.0), dtype=torch.float32)
    td = env.reset()
    for _ in range(5):
        td = step(env, td)
        assert td[keys.VEHICLES, "valid"].all()
    assert (td[keys.VEHICLES, "x"][:, 0] == td[keys.EGO, "distance"]).all()


def test_as_many_episodes_are_blind_as_asked_for_whatever_the_batch_and_the_part():
    parts = {"idm": IdmTraffic(), "idm_mobil": IdmMobilTraffic()}
    traffic = BlindTraffic(MixedTraffic(parts, {"idm": 1, "idm_mobil": 1}), 0.3)
    wide, narrow = (environment(num_envs=n, traffic=traffic).reset()[keys.TRAFFIC, "unseen"] for n in (4000, 7))
    assert torch.equal(wide[:7], narrow)
    assert not wide[:, 1:].any()
    for rows in (wide[0::2, 0], wide[1::2, 0]):
        assert binomtest(int(rows.sum()), len(rows), 0.3).pvalue > 1e-4


def test_generated_drivers_may_be_blind_too():
    env = environment(num_envs=4, traffic=BlindTraffic(gan_traffic(), 1.0), dtype=torch.float32)
    td = env.reset()
    for _ in range(5):
        td = step(env, td)
    assert all(value.isfinite().all() for value in (td[keys.VEHICLES, name] for name in ("x", "y", "speed")))


def test_a_share_out_of_range_is_refused():
    with pytest.raises(UserError, match="from 0 to 1"):
        BlindTraffic(IdmTraffic(), 1.5)
    with pytest.raises(UserError, match=r"traffic\.blind_share=-1"):
        IdmTrafficConfig(blind_share=-1.0)
