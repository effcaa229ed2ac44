"""The reward of section V.C, term by term."""

import pytest
import torch
from reference.refusals import user_error
from reference.worlds import packed
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from ganlane import keys
from ganlane.agents.drivers import RandomDriver
from ganlane.env import HighwayEnv
from ganlane.settings.env import EnvConfig, check_reward
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import RewardParameters, RewardTransform
from ganlane.transforms.reward import speed_reward

CONSIDERATE = RewardParameters(soft_crash_behind=-10.0)


def outcome(speed=20.0, mean_acceleration=0.0, started=False, soft=0, behind=0, **events):
    """The state after a decision of one ego with a desired speed of 25 m/s."""
    events = {**dict.fromkeys(keys.END_EVENTS, False), **events}
    events |= {"soft_crash": soft, "soft_crash_behind": behind}
    content = {
        "vehicles": {"speed": [speed, 0.0], "desired_speed": [25.0, 20.0]},
        "ego": {"mean_acceleration": mean_acceleration, "started_change": started},
        "events": {name: [value] for name, value in events.items()},
    }
    return TensorDict(content).unsqueeze(0)


def terms(parameters=None, **what):
    paid = RewardTransform(1.0, parameters).terms(outcome(**what))
    return {name: value.item() for name, value in paid.items()}


@pytest.mark.parametrize(
    ("speed", "mean_acceleration", "literal", "reward"),
    [
        # 0 at 15 m/s and 1 at the desired speed.
        (15.0, 0.0, False, 0.0),
        (20.0, 0.0, False, 0.5),
        (25.0, 0.0, False, 1.0),
        (10.0, 0.0, False, -0.5),
        (0.0, 0.0, False, -1.5),
        # Hard braking turns it negative and never pays for crawling; the paper's literal sign does.
        (20.0, -1.5, False, 0.5),
        (20.0, -2.5, False, -0.5),
        (10.0, -2.5, False, -0.5),
        (10.0, -2.5, True, 0.5),
    ],
)
def test_the_speed_reward(speed, mean_acceleration, literal, reward):
    parameters = RewardParameters(literal_low_acceleration=literal)
    paid = terms(parameters, speed=speed, mean_acceleration=mean_acceleration)
    assert paid["speed"] == pytest.approx(reward)


@pytest.mark.parametrize(
    ("what", "term", "value"),
    [
        ({"started": True}, "lane_change", -1.0),
        ({"out_of_road": True}, "out_of_road", -100.0),
        ({"hard_crash": True}, "hard_crash", -100.0),
        ({"soft": 1}, "soft_crash", -10.0),
        ({"soft": 3}, "soft_crash", -30.0),
        ({"goal": True}, "goal", 100.0),
    ],
)
def test_each_event_has_its_price(what, term, value):
    assert terms(**what)[term] == value
    assert terms()[term] == 0.0


@pytest.mark.parametrize("parameters", [RewardParameters(), CONSIDERATE])
def test_the_reward_is_the_sum_of_its_terms_and_zero_after_a_reset(parameters):
    """Dense traffic, in which some end."""
    base = HighwayEnv(
        IdmMobilTraffic(), num_envs=32, spawn_parameters=packed(60.0, 12.0), kernel="auto"
    )
    env = TransformedEnv(base, Compose(RewardTransform(1.0, parameters)))
    state = env.reset()
    driver = RandomDriver(base.road)
    ended = 0
    names = parameters.term_names
    assert all((state[keys.REWARD_TERMS, name] == 0).all() for name in names)
    for _ in range(6):
        step, state = env.step_and_maybe_reset(driver(state))
        after = step["next"]
        total = sum(after[keys.REWARD_TERMS, name] for name in names)
        torch.testing.assert_close(total, after["reward"])
        ended += int(after["done"].sum())
        started = state[keys.REWARD_TERMS][after["done"][:, 0]]
        assert all((started[name] == 0).all() for name in names)
    assert ended > 0


def test_the_paper_charges_nothing_for_danger_behind_and_has_no_such_term():
    assert list(terms(behind=3)) == list(keys.REWARD_TERM_NAMES)
    assert terms(behind=3) == terms()


def test_considerate_charges_per_onset_behind_and_is_the_paper_otherwise():
    paid = terms(CONSIDERATE, behind=2, soft=1, started=True)
    assert paid.pop("soft_crash_behind") == -20.0
    assert paid == terms(soft=1, started=True)
    assert terms(CONSIDERATE)["soft_crash_behind"] == 0.0


def test_an_ego_meant_to_drive_no_faster_than_15_mps_would_be_paid_for_crawling_and_is_refused():
    one = torch.ones(1)
    assert speed_reward(one, one, 0.0 * one, RewardParameters()).item() == pytest.approx(1.0)
    with user_error("ego_desired_speed_mps=1"):
        check_reward(EnvConfig(ego_desired_speed_mps=1.0), RewardParameters())
