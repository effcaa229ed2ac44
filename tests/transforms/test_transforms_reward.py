"""The reward of section V.C, term by term."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from ganlane import keys
from ganlane.agents.drivers import RandomDriver
from ganlane.env import HighwayEnv
from ganlane.traffic import IdmMobilTraffic
from ganlane.transforms import RewardParameters, RewardTransform
from ganlane.transforms.reward import speed_reward


def outcome(speed=20.0, mean_acceleration=0.0, started=False, soft=0, **events):
    """The state after a decision of one ego with a desired speed of 25 m/s."""
    flags = {name: torch.tensor([[events.get(name, False)]]) for name in keys.END_EVENTS}
    vehicles = {"speed": torch.tensor([[speed, 0.0]]), "desired_speed": torch.tensor([[25.0, 20.0]])}
    ego = {"mean_acceleration": torch.tensor([mean_acceleration]), "started_change": torch.tensor([started])}
    content = {"vehicles": vehicles, "ego": ego, "events": {**flags, "soft_crash": torch.tensor([[soft]])}}
    return TensorDict({k: TensorDict(v, [1]) for k, v in content.items()}, [1])


def terms(parameters=None, period=1.0, **what):
    return {k: v.item() for k, v in RewardTransform(period, parameters).terms(outcome(**what)).items()}


@pytest.mark.parametrize(("speed", "reward"), [(15.0, 0.0), (20.0, 0.5), (25.0, 1.0), (10.0, -0.5), (0.0, -1.5)])
def test_the_speed_reward_is_0_at_15_and_1_at_the_desired_speed(speed, reward):
    assert terms(speed=speed)["speed"] == pytest.approx(reward)


def test_hard_braking_turns_the_speed_reward_negative_and_never_pays_for_crawling():
    assert terms(speed=20.0, mean_acceleration=-2.5)["speed"] == pytest.approx(-0.5)
    assert terms(speed=10.0, mean_acceleration=-2.5)["speed"] == pytest.approx(-0.5)
    assert terms(speed=20.0, mean_acceleration=-1.5)["speed"] == pytest.approx(0.5)


def test_the_papers_literal_sign_pays_for_crawling_and_is_an_option():
    literal = RewardParameters(literal_low_acceleration=True)
    assert terms(literal, speed=10.0, mean_acceleration=-2.5)["speed"] == pytest.approx(0.5)


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


def test_terms_that_accrue_with_time_follow_the_decision_period():
    assert terms(period=0.1, speed=25.0)["speed"] == pytest.approx(0.1)
    assert terms(period=0.1, hard_crash=True)["hard_crash"] == -100.0


def test_speeds_broadcast_over_a_batch():
    speed, desired = torch.tensor([[15.0], [25.0]]), torch.tensor([[25.0], [25.0]])
    assert speed_reward(speed, desired, torch.zeros(2, 1)).flatten().tolist() == [0.0, 1.0]


def test_the_reward_is_the_sum_of_its_terms_and_zero_after_a_reset():
    base = HighwayEnv(IdmMobilTraffic(), num_envs=32)
    env = TransformedEnv(base, Compose(RewardTransform()))
    state, driver, ended = env.reset(), RandomDriver(base.road), 0
    assert all((state[keys.REWARD_TERMS, name] == 0).all() for name in keys.REWARD_TERM_NAMES)
    for _ in range(12):
        step, state = env.step_and_maybe_reset(driver(state))
        total = sum(step["next", keys.REWARD_TERMS, name] for name in keys.REWARD_TERM_NAMES)
        torch.testing.assert_close(total, step["next", "reward"])
        done = step["next", "done"][:, 0]
        ended += int(done.sum())
        assert all((state[keys.REWARD_TERMS, name][done] == 0).all() for name in keys.REWARD_TERM_NAMES)
    assert ended > 0
