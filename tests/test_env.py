"""The environment as its users meet it: specs, resets, commands, events and ends."""

from __future__ import annotations

import pytest
import torch
from reference.worlds import environment, placed, same_bits, step, vehicles
from torchrl.collectors import Collector
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from ganlane import keys
from ganlane.agents.drivers import KeepLaneDriver
from ganlane.env import EpisodeParameters
from ganlane.errors import UserError
from ganlane.sim.random import Stream

KEEP, LEFT, RIGHT = keys.KEEP, keys.LEFT, keys.RIGHT
FAR = {"x": 2000.0, "lane": 0}


def reasons(td, row: int = 0) -> list[str]:
    return [name for name in keys.END_EVENTS if td[keys.EVENTS, name][row].item()]


def flags(td, row: int = 0) -> tuple[bool, bool, bool]:
    return tuple(td[name][row].item() for name in ("terminated", "truncated", "done"))


# Specs and seeds


@pytest.mark.parametrize("mobil", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_environment_keeps_its_specs(mobil, dtype):
    check_env_specs(environment(num_envs=3, mobil=mobil, dtype=dtype))


def test_a_rollout_has_a_time_axis_and_resets_by_itself():
    env = environment(num_envs=4, goal_m=40.0)
    track = env.rollout(12, break_when_any_done=False)
    assert track.batch_size == (4, 12)
    assert track["next", "done"].sum() > 4
    assert track[keys.EPISODE].max() >= 4


def test_a_seed_gives_the_same_episodes_again_and_another_one_others():
    env = environment(num_envs=5, seed=3)
    first = env.reset()
    env.set_seed(4)
    other = env.reset()
    env.set_seed(3)
    assert same_bits(first, env.reset()) == []
    assert not torch.equal(first[keys.VEHICLES, "x"], other[keys.VEHICLES, "x"])


def test_training_and_reported_episodes_are_different_ones():
    scenes = [environment(num_envs=4, stream=stream).reset()[keys.VEHICLES, "speed"] for stream in Stream]
    assert not torch.equal(scenes[0], scenes[1])
    assert not torch.equal(scenes[1], scenes[2])


def test_row_i_starts_with_episode_first_plus_i():
    assert environment(num_envs=3, first_episode=2**40).reset()[keys.EPISODE].tolist() == [
        2**40 + i for i in range(3)
    ]


def test_after_a_reset_nothing_has_happened_yet():
    td = environment(num_envs=2).reset()
    assert td[keys.STEP].tolist() == [0, 0]
    for group in (keys.EVENTS, keys.EGO):
        assert all(not value.any() for value in td[group].values())
    assert not td["done"].any()


def test_vehicles_that_do_not_fit_are_refused():
    with pytest.raises(UserError, match=r"^vehicles=30 do not fit"):
        environment(lanes=3, vehicles=30)


@pytest.mark.parametrize("period", [0.05, 0.25, 0.0, -1.0])
def test_a_decision_is_a_whole_number_of_physics_steps(period):
    with pytest.raises(UserError, match="decision_period_s"):
        environment(period_s=period)


@pytest.mark.parametrize(("period", "substeps"), [(0.1, 1), (0.3, 3), (0.7, 7), (1.0, 10), (2.0, 20)])
def test_decision_periods_and_their_substeps(period, substeps):
    episode = EpisodeParameters(decision_period_s=period)
    assert episode.substeps() == substeps
    env = environment(period_s=period)
    assert step(env, env.reset())[keys.STEP].tolist() == [substeps]


# Resets


def test_a_partial_reset_leaves_the_other_rows_as_they_are_bit_for_bit():
    env = environment(num_envs=5, seed=9)
    td = env.reset()
    for action in (LEFT, KEEP, RIGHT):
        td = step(env, td, action)
    mask = torch.tensor([False, True, False, False, True])
    asked = td.clone()
    asked["_reset"] = mask[:, None]
    after = env.reset(asked).exclude("_reset", "reward")
    kept = (~mask).nonzero()[:, 0]
    assert same_bits(after[kept], td.exclude("reward")[kept]) == []
    assert after[keys.EPISODE].tolist() == [0, 6, 2, 3, 9]
    whole = environment(num_envs=10, seed=9).reset()
    assert same_bits(after[mask], whole[torch.tensor([6, 9])]) == []


def test_an_automatic_reset_goes_on_with_episode_i_plus_n():
    env = environment(num_envs=3)
    td = env.reset()
    td["action"] = torch.tensor([KEEP, LEFT, KEEP])
    td[keys.VEHICLES, "target_lane"][1, 0] = 2  # so that its command leaves the road
    stepped, going_on = env.step_and_maybe_reset(td)
    assert reasons(stepped["next"], 1) == ["out_of_road"]
    assert going_on[keys.EPISODE].tolist() == [0, 4, 2]
    assert going_on[keys.STEP].tolist() == [10, 0, 10]
    assert same_bits(going_on[[0, 2]].exclude("action", "reward"), stepped["next"][[0, 2]].exclude("reward")) == []


def test_under_a_transform_and_in_a_collector_every_episode_is_driven_once():
    env = environment(num_envs=3, goal_m=40.0)
    driver = KeepLaneDriver(env.road)
    collector = Collector(
        TransformedEnv(env, StepCounter()),
        driver,
        frames_per_batch=3 * 20,
        total_frames=3 * 20,
        auto_register_policy_transforms=False,
    )
    batch = next(iter(collector))
    collector.shutdown()
    done = batch["next", "done"][..., 0]
    episodes = batch[keys.EPISODE]
    for row in range(3):
        finished = episodes[row][done[row]].tolist()
        assert len(finished) > 2
        assert finished == [row + 3 * k for k in range(len(finished))]


def test_a_reset_with_seed_and_episode_runs_exactly_those():
    env = environment(num_envs=3)
    td = env.reset().select(keys.SEED, keys.EPISODE)
    td[keys.SEED], td[keys.EPISODE] = torch.tensor([5, 0, 5]), torch.tensor([40, 2, 0])
    asked = env.reset(td)
    assert asked[keys.EPISODE].tolist() == [40, 2, 0]
    assert same_bits(asked[1:2], env.reset()[2:3]) == []
    assert same_bits(asked[2:3], environment(num_envs=1, seed=5).reset()) == []


def test_a_copied_state_goes_on_alike_and_is_not_written():
    env = environment(num_envs=4)
    td = step(env, env.reset(), LEFT)
    kept = td.clone()
    td["action"] = torch.tensor([KEEP, LEFT, RIGHT, KEEP])
    twice = [env.step(td)["next"].clone() for _ in range(2)]
    assert same_bits(*twice) == []
    assert same_bits(td.exclude("action", "next"), kept) == []


# Commands


def test_a_command_moves_the_ego_one_lane_and_commands_meanwhile_are_ignored():
    env = environment(lanes=4, vehicles=2, mobil=False)
    td = placed(env, vehicles({"x": 0.0, "lane": 1}, FAR))
    td = step(env, td, LEFT)
    assert td[keys.EGO, "started_change"].item()
    assert td[keys.EGO, "change_direction"].item() == 1
    assert 0.0 < td[keys.EGO, "change_progress"].item() < 1.0
    for action in (LEFT, RIGHT):
        td = step(env, td, action)
        assert not td[keys.EGO, "started_change"].item()
        assert td[keys.VEHICLES, "target_lane"][0, 0] == 2
        assert reasons(td) == []
    td = step(env, step(env, td))
    assert td[keys.VEHICLES, "y"][0, 0].item() == pytest.approx(8.0, abs=0.1)
    assert td[keys.EGO, "change_direction"].item() == 0
    assert td[keys.EGO, "change_progress"].item() == 0.0
    assert td[keys.EGO, "lane_changes"].item() == 1
    assert td[keys.EGO, "decisions"].item() == 5
    assert step(env, td, RIGHT)[keys.EGO, "change_direction"].item() == -1


def test_a_command_off_the_road_is_ignored_in_the_middle_of_a_change():
    env = environment(lanes=2, vehicles=2, mobil=False)
    td = step(env, placed(env, vehicles({"x": 0.0, "lane": 0}, FAR)), LEFT)
    td = step(env, td, LEFT)
    assert reasons(td) == []


def test_with_abort_the_opposite_command_turns_back_and_the_same_one_does_nothing():
    env = environment(lanes=3, vehicles=2, mobil=False, abort=True)
    td = step(env, placed(env, vehicles({"x": 0.0, "lane": 0}, FAR)), LEFT)
    again = step(env, td, LEFT)
    assert again[keys.VEHICLES, "target_lane"][0, 0] == 1
    assert again[keys.EGO, "lane_changes"].item() == 1
    back = step(env, td, RIGHT)
    assert back[keys.VEHICLES, "target_lane"][0, 0] == 0
    assert back[keys.EGO, "started_change"].item()
    for _ in range(6):
        back = step(env, back)
    assert back[keys.VEHICLES, "y"][0, 0].abs() < 0.1
    assert back[keys.EGO, "change_direction"].item() == 0


@pytest.mark.parametrize(("lane", "action"), [(0, RIGHT), (2, LEFT)])
def test_a_command_off_the_road_ends_the_episode_at_once(lane, action):
    env = environment(vehicles=2)
    td = placed(env, vehicles({"x": 0.0, "lane": lane}, FAR))
    after = step(env, td, action)
    assert reasons(after) == ["out_of_road"]
    assert flags(after) == (True, False, True)
    assert same_bits(after[keys.VEHICLES], td[keys.VEHICLES]) == []
    assert after[keys.STEP].item() == 0
    assert not after[keys.EGO, "started_change"].item()


def test_the_mean_acceleration_is_the_change_of_speed_over_the_time_driven():
    env = environment(vehicles=2, mobil=False, lanes=1)
    td = placed(env, vehicles({"x": 0.0, "lane": 0, "speed": 20.0}, {"x": 40.0, "lane": 0, "speed": 5.0}))
    after = step(env, td)
    change = after[keys.VEHICLES, "speed"][0, 0] - 20.0
    assert change < -2.0
    assert after[keys.EGO, "mean_acceleration"].item() == pytest.approx(change.item() / 1.0)
    assert after[keys.EGO, "distance"].item() == after[keys.VEHICLES, "x"][0, 0].item()


# Ends


def test_the_goal_ends_the_episode_at_the_step_that_reaches_it():
    env = environment(vehicles=2, mobil=False, goal_m=1000.0)
    td = step(env, placed(env, vehicles({"x": 995.1, "lane": 1, "speed": 25.0}, FAR)))
    assert reasons(td) == ["goal"]
    assert flags(td) == (True, False, True)
    # At 25 m/s, 2.5 m a step: 997.6, then 1000.1.
    assert td[keys.STEP].item() == 2
    assert td[keys.EGO, "distance"].item() == pytest.approx(1000.1, abs=1e-3)


def test_within_one_step_a_hard_crash_comes_before_the_goal():
    """1 m before the goal at 20 m/s, half a metre behind a standing car."""
    env = environment(vehicles=3, mobil=False, goal_m=1000.0)
    wall = {"x": 1004.0, "lane": 1, "speed": 0.0}, {"x": 1009.0, "lane": 1, "speed": 0.0}
    td = step(env, placed(env, vehicles({"x": 999.0, "lane": 1, "speed": 20.0}, *wall)))
    assert td[keys.EGO, "distance"].item() > 1000.0
    assert reasons(td) == ["hard_crash"]
    assert flags(td) == (True, False, True)
    assert td[keys.STEP].item() == 1


def test_the_goal_reached_a_step_before_a_crash_counts():
    env = environment(vehicles=3, mobil=False, goal_m=1000.0)
    wall = {"x": 1006.5, "lane": 1, "speed": 0.0}, {"x": 1011.5, "lane": 1, "speed": 0.0}
    td = step(env, placed(env, vehicles({"x": 999.0, "lane": 1, "speed": 20.0}, *wall)))
    assert reasons(td) == ["goal"]


def test_a_crash_with_a_vehicle_that_is_not_valid_is_none():
    env = environment(vehicles=2, mobil=False)
    ghost = {"x": 10.0, "lane": 1, "speed": 0.0, "valid": False}
    td = step(env, placed(env, vehicles({"x": 0.0, "lane": 1, "speed": 20.0}, ghost)))
    assert reasons(td) == []
    assert td[keys.EVENTS, keys.SOFT_CRASH].item() == 0


def test_the_time_limit_truncates_in_the_middle_of_a_decision():
    env = environment(period_s=2.0, timeout_s=3.0)
    td = step(env, env.reset())
    assert reasons(td) == []
    td = step(env, td)
    assert reasons(td) == ["timeout"]
    assert flags(td) == (False, True, True)
    assert td[keys.STEP].item() == 30


def test_a_row_that_has_ended_stays_as_it_was_while_the_others_drive_on():
    """Row 0 reaches the goal in its second step, row 1 does not; row 0 keeps what it had then."""
    goal = {"vehicles": 2, "mobil": True, "goal_m": 1000.0}
    scene = vehicles({"x": 995.1, "lane": 1, "speed": 25.0}, {"x": 980.0, "lane": 0, "speed": 20.0})
    env = environment(num_envs=2, **goal)
    td = env.reset()
    for name, value in scene.as_dict().items():
        td[keys.VEHICLES, name] = value.repeat(2, 1)
    td[keys.VEHICLES, "x"][1] -= 500.0
    both = step(env, td, LEFT)
    assert both[keys.STEP].tolist() == [2, 10]
    short = environment(num_envs=1, period_s=0.2, **goal)
    alone = step(short, placed(short, scene), LEFT)
    for group in (keys.VEHICLES, keys.TRAFFIC):
        assert same_bits(both[group][:1], alone[group]) == []


# Soft crashes


def standing(gap: float, behind: bool = False) -> list[dict]:
    """The ego at rest with its neighbour ``gap`` m ahead or behind, and a third that keeps them from driving off."""
    ego = {"x": 0.0, "lane": 1, "speed": 0.0}
    near, third = (-4.5 - gap, 4.5 + 2.0) if behind else (4.5 + gap, 9.0 + gap + 0.5)
    return [ego, {**ego, "x": near}, {**ego, "x": third}]


@pytest.mark.parametrize("behind", [False, True])
def test_a_soft_crash_counts_once_until_it_is_over(behind):
    env = environment(vehicles=3, mobil=False)
    td = env.reset()
    counts = {keys.SOFT_CRASH: [], keys.SOFT_CRASH_BEHIND: []}
    for gap in (1.5, 1.5, 3.0, 1.5, 1.5):
        for name, value in vehicles(*standing(gap, behind)).as_dict().items():
            td[keys.VEHICLES, name] = value
        td = step(env, td)
        for name, count in counts.items():
            count.append(td[keys.EVENTS, name].item())
    here, there = (keys.SOFT_CRASH_BEHIND, keys.SOFT_CRASH) if behind else (keys.SOFT_CRASH, keys.SOFT_CRASH_BEHIND)
    assert counts == {here: [1, 0, 0, 1, 0], there: [0, 0, 0, 0, 0]}


def test_closing_in_within_1_5_s_is_a_soft_crash_and_in_another_lane_it_is_none():
    env = environment(vehicles=2, mobil=False)
    for lane, expected in ((1, 1), (2, 0)):
        slow = {"x": 4.5 + 18.0, "lane": lane, "speed": 5.0}  # 1.2 s at a closing speed of 15 m/s
        td = step(env, placed(env, vehicles({"x": 0.0, "lane": 1, "speed": 20.0}, slow)))
        assert td[keys.EVENTS, keys.SOFT_CRASH].item() == expected


def test_a_soft_crash_is_no_end():
    env = environment(vehicles=3, mobil=False)
    td = step(env, placed(env, vehicles(*standing(1.5))))
    assert td[keys.EVENTS, keys.SOFT_CRASH].item() == 1
    assert flags(td) == (False, False, False)
