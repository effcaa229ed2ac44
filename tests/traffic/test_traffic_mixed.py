"""Mixtures of traffics, in which each part drives as it would alone, and traffic that does not see
the ego.
"""

import pytest
import torch
from reference.refusals import user_error
from reference.traffics import MAKE, assert_close
from reference.worlds import (
    environment,
    episode_keys,
    few_changes,
    placed,
    run,
    same_bits,
    vehicles,
)
from scipy.stats import binomtest

import ganlane
from ganlane import keys
from ganlane.build import make_traffic
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmTrafficConfig, MixedTrafficConfig, ReplayTrafficConfig
from ganlane.sim import Road, Vehicles
from ganlane.traffic import (
    BlindTraffic,
    IdmTraffic,
    MixedTraffic,
)
from ganlane.traffic.mixed import interleaved
from ganlane.traffic.presets import gan_traffic, with_faults

RULES = {"idm": 1, "idm_mobil": 2, "idm_random": 1, "idm_faults": 1}


def mixture(**shares):
    return MixedTraffic({name: MAKE[name]() for name in shares}, shares)


def drive(traffic, rows, decisions=6):
    env = environment(num_envs=rows, traffic=traffic, dtype=torch.float32)
    return run(env, decisions, few_changes)


@pytest.mark.parametrize(
    ("shares", "turns"),
    [
        ({"a": 1, "b": 1}, "ab"),
        ({"a": 2, "b": 1}, "aba"),
        ({"a": 3, "b": 1}, "aaba"),
        ({"a": 1, "b": 1, "c": 2}, "cabc"),
        ({"a": 4}, "aaaa"),
    ],
)
def test_the_turns_of_a_period_are_spread(shares, turns):
    assert "".join(interleaved(shares)) == turns


@pytest.fixture(scope="module")
def wide():
    """States of 64 episodes."""
    return drive(mixture(**RULES), 64)


@pytest.mark.parametrize("rows", [1, 6])
def test_an_episode_is_the_same_bits_in_every_batch_and_in_every_rule_driven_traffic(rows, wide):
    narrow = drive(mixture(**RULES), rows)
    for all_rows, some in zip(wide, narrow):
        assert same_bits(all_rows[:rows], some) == []
    faulty = wide[-1][keys.TRAFFIC, "idm_faults"]
    assert all((faulty[fault, "left"] > 0).any() for fault in ("phantom_braking", "late_reaction"))


@pytest.mark.parametrize("name", sorted(RULES))
def test_a_part_drives_its_episodes_to_the_bit_as_it_does_alone(name, wide):
    rows = [row for row in range(20) if interleaved(RULES)[row % 5] == name]
    for one, other in zip(wide, drive(MAKE[name](), 20)):
        assert same_bits(one[rows].exclude(keys.TRAFFIC), other[rows].exclude(keys.TRAFFIC)) == []
        assert same_bits(one[rows][keys.TRAFFIC, name], other[rows][keys.TRAFFIC]) == []


def test_the_generator_drives_its_rows_as_it_does_alone_to_rounding():
    assert_close(
        *(
            drive(traffic, 8, 3)[-1][1::2][keys.VEHICLES]
            for traffic in (mixture(idm_mobil=1, gan=1), gan_traffic())
        )
    )


def test_scenes_set_by_hand_and_faults_laid_over_a_mixture_see_it_too():
    halves = {"name": "mixed", "shares": {"gan": 1, "idm": 1}}
    start = ganlane.make_env(halves, 4, env="cut_in").reset()
    assert (start[keys.VEHICLES, "visibility"] >= 0).all()
    chain = drive(with_faults(mixture(idm=1, gan=1)), 4, 2)[-1]
    assert chain[keys.VEHICLES, "visibility"][:, 1].tolist() == [2, 1, 2, 1]


@pytest.mark.parametrize(
    ("shares", "told"),
    [
        ({"replay": 1}, "replay: it plays recordings"),
        ({"idm_mobli": 1}, "did you mean 'idm_mobil'"),
        ({}, "whole numbers of at least 1"),
        ({"idm": 2000}, "whole numbers of at least 1"),
        ({"idm": 0}, "expected at least 1"),
        ({"idm": 0.5}, "expected a whole number"),
        (3, "expected names with values"),
        ({"mixed": 1}, "is a mixture itself"),
    ],
)
def test_shares_that_cannot_be_are_refused_in_one_sentence(shares, told):
    with user_error(told):
        MixedTrafficConfig(shares=shares)


def test_parts_on_different_roads_and_impossible_shares_of_blind_episodes_are_refused():
    with user_error("different roads or streams"):
        MixedTraffic({"a": IdmTraffic(), "b": IdmTraffic(Road(lanes=2))}, {"a": 1, "b": 1})
    with user_error("no ego anyway"):
        ReplayTrafficConfig(blind_share=0.5)
    with user_error("blind_share=-1"):
        IdmTrafficConfig(blind_share=-1.0)


def test_a_model_of_ones_own_is_mixed_by_its_import_path():
    traffic = make_traffic(
        MixedTrafficConfig(shares={"ganlane.traffic.IdmTraffic": 1, "idm_mobil": 1}), EnvConfig()
    )
    names = [name for name, _ in traffic.named_parts()]
    assert names == ["ganlane_traffic_IdmTraffic", "idm_mobil"]
    models = (traffic, mixture(idm=1, idm_mobil=1))
    assert same_bits(*(drive(model, 4)[-1].exclude(keys.TRAFFIC) for model in models)) == []


# Blind episodes: the others do not see the ego, the environment does


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_follower_brakes_for_an_ego_unless_it_does_not_see_it_and_the_environment_says_so(share):
    """A fast driver behind a slow ego, second by second."""
    env = environment(vehicles=2, traffic=BlindTraffic(IdmTraffic(), share))
    slow, fast = ({"speed": speed, "desired_speed": speed} for speed in (10.0, 25.0))
    start = placed(env, vehicles({"x": 0.0, **slow}, {"x": -60.0, **fast}))
    track = run(env, 8, start=start)
    slowest = min(td[keys.VEHICLES, "speed"][0, 1].item() for td in track)
    assert any(bool(td[keys.EVENTS, "hard_crash"]) for td in track) == (share == 1.0)
    assert slowest > 24.9 if share else slowest < 15.0


def test_as_many_episodes_are_blind_as_asked_for_whatever_the_batch_and_the_part():
    traffic = BlindTraffic(mixture(idm=1, idm_mobil=1), 0.3)
    unseen = []
    for n in (4000, 7):
        td = environment(num_envs=n, traffic=traffic).reset()
        vehicles = Vehicles.of(td[keys.VEHICLES])
        unseen.append(traffic.unseen(vehicles, episode_keys(range(n))))
    wide, narrow = unseen
    assert torch.equal(wide[:7], narrow)
    assert not wide[:, 1:].any()
    for rows in (wide[0::2, 0], wide[1::2, 0]):
        assert binomtest(int(rows.sum()), len(rows), 0.3).pvalue > 1e-4
