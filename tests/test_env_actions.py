"""Egos that are commanded more than a lane: `lane_speed` and `continuous`."""

import gymnasium
import numpy as np
import pytest
import torch
from reference.refusals import user_error
from reference.worlds import environment, few_changes, placed, run, same_bits, step, vehicles
from torchrl.envs.utils import check_env_specs

import ganlane
from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.settings.actions import ActionParameters
from ganlane.transforms import ActionMaskTransform, observation_size

KEEP, LEFT, RIGHT, FASTER, SLOWER = range(5)
FAR = {"x": -900.0}


def alone(form: str, **ego: float) -> tuple:
    """An environment and its state, with the ego alone in the right lane at 20 m/s."""
    env = environment(vehicles=2, mobil=False, actions=ActionParameters(form))
    return env, placed(env, vehicles({"x": 0.0, "visibility": 1, **ego}, FAR))


def driven(env: HighwayEnv, td, action, decisions: int):
    return run(env, decisions, lambda _: action, td)[-1]


def ego(td, name: str) -> float:
    return td[keys.VEHICLES, name][0, 0].item()


# lane_speed


def test_an_ego_that_is_told_slower_slows_down_to_the_lowest_speed_and_faster_to_the_desired_one():
    env, td = alone("lane_speed", speed=6.0)
    slow = driven(env, td, SLOWER, 20)
    assert ego(slow, "speed") == pytest.approx(5.0, abs=0.1)
    fast = driven(env, slow, FASTER, 60)
    assert ego(fast, "speed") == pytest.approx(25.0, abs=0.3)
    assert ego(fast, "desired_speed") == ego(slow, "desired_speed") == 25.0


def test_without_commands_of_speed_an_episode_is_the_same_as_with_the_papers_actions():
    paper, more = (
        run(environment(num_envs=16, seed=3, actions=ActionParameters(form)), 8, few_changes)
        for form in ("lane", "lane_speed")
    )
    for one, other in zip(paper, more):
        assert same_bits(one[keys.VEHICLES], other[keys.VEHICLES]) == []


def test_faster_and_slower_are_allowed_where_they_have_an_effect():
    env, td = alone("lane_speed")
    mask = ActionMaskTransform(env.road, "legal", actions=env.actions)
    td = mask._call(td)
    assert td[keys.ACTION_MASK][0].tolist() == [True, True, False, False, True]
    td = mask._call(driven(env, td, SLOWER, 12))
    assert td[keys.ACTION_MASK][0].tolist() == [True, True, False, True, False]


def test_the_speed_aimed_at_is_the_last_number_of_the_observation():
    env = ganlane.make_env(actions="lane_speed", seed=1)
    td = env.reset()
    assert td["observation"][0, -1] == 1.0
    td = step(env, td, SLOWER)
    assert td["observation"][0, -1].item() == pytest.approx(0.9)
    assert td["observation"].shape[1] == observation_size("lane_view_overlap", 9) + 1


# continuous


@pytest.mark.parametrize(("wheel", "y", "changes"), [(1.0, 4.0, 1), (0.25, 1.0, 0)])
def test_a_wheel_of_one_leads_to_the_next_lane_and_less_to_a_line_within_the_lane(
    wheel, y, changes
):
    env, td = alone("continuous")
    while ego(td, "y") < 0.5 * y:
        td = step(env, td, (0.0, wheel))
    assert td[keys.EGO, "lane_changes"] == changes
    # Of zero it keeps the centre of the next lane.
    td = driven(env, td, (0.0, wheel % 1.0), 8)
    assert ego(td, "y") == pytest.approx(y, abs=0.05)
    assert td[keys.EGO, "lane_changes"] == changes
    assert td[keys.EGO, "change_direction"] == 0


# In the libraries


@pytest.mark.parametrize(
    ("actions", "env"), [("lane", "highway"), ("lane_speed", "merge"), ("continuous", "exit")]
)
def test_torchrl_finds_nothing_wrong(actions, env):
    check_env_specs(ganlane.make_env(num_envs=3, env=env, actions=actions))


@pytest.mark.parametrize(
    ("action", "wrong"),
    [
        (torch.zeros(1, dtype=torch.int64), "of shape"),
        (torch.tensor([[torch.nan, 0.0]]), "not finite"),
        (torch.zeros(1, 3), "of shape"),
    ],
)
def test_controls_of_another_kind_are_refused(action, wrong):
    env, td = alone("continuous")
    with user_error(wrong):
        env.step(td.set("action", action))


@pytest.mark.parametrize("action", [[2.0], 1, [0.0, np.inf]])
def test_gymnasium_refuses_them_too(action):
    env = gymnasium.make("ganlane/Highway-v0", actions="continuous").unwrapped
    env.reset(seed=0)
    with user_error("acceleration and lateral target"):
        env.step(action)


def test_masks_and_commands_that_know_numbered_lanes_alone_say_so():
    with user_error("leave the mask out"):
        ganlane.make_env(actions="continuous", mask="safe")
    with user_error("Rainbow chooses among numbered actions"):
        ganlane.api.train(actions="continuous", mask="none")
    with user_error("expected one of lane, lane_speed, continuous"):
        ganlane.make_env(actions="pedals")


def test_drivers_by_rule_drive_in_the_same_table_as_those_of_other_actions():
    """An environment of `continuous` is compared with MOBIL, which commands lanes."""
    table = ganlane.api.evaluate(["mobil"], ["idm"], 2, actions="continuous", goal_m=200.0)
    assert table["goal"].to_list() == [2]
