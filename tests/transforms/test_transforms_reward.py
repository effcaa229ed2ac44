"""The reward of section V.C, term by term."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from ganlane import keys
from ganlane.agents.drivers import RandomDriver
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane.settings.env import EnvConfig, check_reward
from ganlane.sim.scenes import FixedScene, SceneVehicle
from ganlane.traffic import IdmMobilTraffic, IdmTraffic
from ganlane.transforms import RewardParameters, RewardTransform
from ganlane.transforms.reward import speed_reward

CONSIDERATE = RewardParameters(soft_crash_behind=-10.0)


def outcome(speed=20.0, mean_acceleration=0.0, started=False, soft=0, behind=0, **events):
    """The state after a decision of one ego with a desired speed of 25 m/s."""
    flags = {name: torch.tensor([[events.get(name, False)]]) for name in keys.END_EVENTS}
    vehicles = {
        "speed": torch.tensor([[speed, 0.0]]),
        "desired_speed": torch.tensor([[25.0, 20.0]]),
    }
    ego = {
        "mean_acceleration": torch.tensor([mean_acceleration]),
        "started_change": torch.tensor([started]),
    }
    onsets = {"soft_crash": torch.tensor([[soft]]), "soft_crash_behind": torch.tensor([[behind]])}
    content = {"vehicles": vehicles, "ego": ego, "events": {**flags, **onsets}}
    return TensorDict({k: TensorDict(v, [1]) for k, v in content.items()}, [1])


def terms(parameters=None, period=1.0, **what):
    return {
        k: v.item() for k, v in RewardTransform(period, parameters).terms(outcome(**what)).items()
    }


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
    assert terms(parameters, speed=speed, mean_acceleration=mean_acceleration)[
        "speed"
    ] == pytest.approx(reward)


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
    base = HighwayEnv(IdmMobilTraffic(), num_envs=8)
    env = TransformedEnv(base, Compose(RewardTransform(1.0, parameters)))
    state = env.reset()
    driver = RandomDriver(base.road)
    ended = 0
    names = parameters.term_names
    assert env.observation_spec.contains(state.select(*env.observation_spec.keys()))
    assert all((state[keys.REWARD_TERMS, name] == 0).all() for name in names)
    for _ in range(12):
        step, state = env.step_and_maybe_reset(driver(state))
        total = sum(step["next", keys.REWARD_TERMS, name] for name in names)
        torch.testing.assert_close(total, step["next", "reward"])
        done = step["next", "done"][:, 0]
        ended += int(done.sum())
        assert all((state[keys.REWARD_TERMS, name][done] == 0).all() for name in names)
    assert ended > 0


def test_the_paper_charges_nothing_for_danger_behind_and_has_no_such_term():
    assert list(terms(behind=3)) == list(keys.REWARD_TERM_NAMES)
    assert terms(behind=3) == terms()


def test_considerate_charges_per_onset_behind_and_is_the_paper_otherwise():
    paid = terms(CONSIDERATE, behind=2, soft=1, started=True)
    assert paid.pop("soft_crash_behind") == -20.0
    assert paid == terms(soft=1, started=True)
    assert terms(CONSIDERATE)["soft_crash_behind"] == 0.0


def changes_left(behind_m, parameters=None):
    """The rewards of an ego at 15 m/s that goes left at once, ``behind_m`` in front of a driver at
    25 m/s there.
    """
    scene = FixedScene((SceneVehicle(0.0, 0, 15.0), SceneVehicle(-behind_m, 1, 25.0, 25.0)))
    env = TransformedEnv(HighwayEnv(IdmTraffic(), scenes=scene), RewardTransform(1.0, parameters))
    state = env.reset()
    rewards = []
    for action in (keys.LEFT, keys.KEEP, keys.KEEP, keys.KEEP):
        after = env.step(state.set("action", torch.full((1,), action)))["next"]
        rewards.append(after.select("reward", keys.REWARD_TERMS, keys.EVENTS))
        state = after.exclude("reward")
    return torch.stack(rewards)


def test_who_cuts_in_before_a_fast_driver_pays_and_who_leaves_room_does_not():
    """The other, 15.5 m behind the rear bumper, closes in at 10 m/s.

    It is 1.55 s away, and nearer at every step.
    """
    cut_in = changes_left(20.0, CONSIDERATE)
    onsets = cut_in[keys.EVENTS, "soft_crash_behind"]
    assert onsets.sum() >= 1
    assert torch.equal(cut_in[keys.REWARD_TERMS, "soft_crash_behind"], -10.0 * onsets)
    assert not cut_in[keys.EVENTS, "hard_crash"].any()
    room = changes_left(90.0, CONSIDERATE)
    assert (room[keys.REWARD_TERMS, "soft_crash_behind"] == 0).all()


def test_an_ego_meant_to_drive_no_faster_than_15_mps_would_be_paid_for_crawling_and_is_refused():
    standing = torch.zeros(1)
    assert speed_reward(standing + 1.0, standing + 1.0, standing).item() == pytest.approx(1.0)
    with pytest.raises(UserError, match="ego_desired_speed_mps=1"):
        check_reward(EnvConfig(ego_desired_speed_mps=1.0), RewardParameters())
