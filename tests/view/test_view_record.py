"""A recorded episode is the episode that the environment drove."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv

from ganlane.build import make_driver, make_env, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig
from ganlane.data import SyntheticTraffic, sort, synthetic_scenes
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.errors import UserError
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic import Recordings, ReplayTraffic
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.view import record_episode


def always(action):
    return TensorDictModule(lambda step: torch.full_like(step, action), in_keys=["step"], out_keys=["action"])


def highway(rows=1, goal_m=150.0, lanes=3, vehicles=5):
    return HighwayEnv(
        IdmMobilTraffic(Road(lanes=lanes)),
        rows,
        vehicles=vehicles,
        episode=EpisodeParameters(goal_m=goal_m),
        stream=Stream.TRAIN,
    )


def test_the_recording_has_a_frame_per_physics_step():
    env = highway()
    trajectory = record_episode(env, always(0), seed=4, episode=7, agent="keep_lane", traffic="idm_mobil")
    state = env.reset(env.reset().update({"seed": torch.tensor([4]), "episode": torch.tensor([7])}))
    assert trajectory.x[0] == pytest.approx(state["vehicles", "x"][0].double().numpy())
    while not state["done"].any():
        state = env.step_mdp(env.step(state.set("action", torch.tensor([0]))))
    assert len(trajectory) == int(state["step"]) + 1
    assert trajectory.time_s[-1] == pytest.approx(0.1 * int(state["step"]))
    assert trajectory.x[-1] == pytest.approx(state["vehicles", "x"][0].double().numpy())
    assert trajectory.x[-1, 0] >= 150.0 > trajectory.x[-2, 0]
    assert trajectory.outcome == "goal"
    assert trajectory.action.tolist() == [-1] + [0] * (len(trajectory) - 1)
    assert (trajectory.label.agent, trajectory.label.lanes, trajectory.label.lane_width_m) == ("keep_lane", 3, 4.0)


def test_the_label_has_the_road_of_the_replayed_scene():
    """Three scenes of 2, 3 and 4 lanes: the environment's own road has the lanes of the widest."""
    parts = [
        synthetic_scenes(SyntheticTraffic(scenes=1, lanes=2 + k, seconds=7.0), seed=k).with_columns(
            scene=pl.lit(f"{2 + k} lanes")
        )
        for k in range(3)
    ]
    traffic = ReplayTraffic(recordings=Recordings.of(sort(pl.concat(parts)), "synthetic", 5.0))
    env = HighwayEnv(traffic, 1, vehicles=5)
    names = traffic.scenes_of_episodes(0, range(10))
    for lanes in (2, 3, 4):
        episode = names.index(f"{lanes} lanes")
        label = record_episode(env, always(0), seed=0, episode=episode, max_time_s=1.0).label
        assert label.lanes == lanes


def test_frames_are_one_step_of_driving_apart():
    trajectory = record_episode(highway(goal_m=60.0), always(0), seed=0, episode=0)
    moved = np.diff(trajectory.x, axis=0)
    assert np.abs(moved - 0.1 * trajectory.speed[:-1]).max() < 0.05
    assert trajectory.frame_s == pytest.approx(0.1)
    assert not trajectory.overlapping().any()
    assert not trajectory.jumped().any()


def test_frames_a_second_apart_hold_no_jumps_of_who_just_drives():
    whole = record_episode(highway(goal_m=200.0), always(0), seed=0, episode=0)
    fields = {name: getattr(whole, name)[::10] for name in ("time_s", "x")}
    coarse = replace(whole, **fields)
    assert np.abs(np.diff(coarse.x, axis=0)).max() > 10.0
    assert not coarse.jumped().any()
    coarse.x[-1] += 301.0
    assert coarse.jumped()[-1].all()
    whole.x[-1] += 40.0
    assert whole.jumped()[-1].all()


def test_a_command_off_the_road_ends_the_recording_at_once():
    trajectory = record_episode(highway(lanes=1), always(1), seed=0, episode=0)
    assert trajectory.outcome == "out_of_road"
    assert len(trajectory) == 1


def test_the_batch_makes_no_difference_and_the_hook_is_taken_out_again():
    env = highway(rows=3, goal_m=60.0)
    trajectory = record_episode(env, always(0), seed=1, episode=5)
    alone = record_episode(highway(goal_m=60.0), always(0), seed=1, episode=5)
    assert np.array_equal(trajectory.x, alone.x)
    assert env.recorder is None


def test_a_recording_can_be_cut_off():
    trajectory = record_episode(highway(goal_m=5000.0), always(0), seed=0, episode=0, max_time_s=3.0)
    assert trajectory.outcome == ""
    assert trajectory.time_s[-1] == pytest.approx(3.0)


def test_an_environment_without_the_hook_cannot_be_recorded():
    with pytest.raises(UserError, match="HighwayEnv"):
        record_episode(GymEnv("CartPole-v1"), always(0), seed=0, episode=0)


def test_a_network_tells_its_values_and_the_rewards_add_up():
    """A policy of a Q-network leaves what it expected at each decision; others leave nothing."""
    config = EnvConfig(goal_m=60.0)
    driver = make_driver("agent_idm", config)
    env = make_env(make_traffic(IdmMobilTrafficConfig(), config), config, driver.observation)
    trajectory = record_episode(env, driver.policy, seed=0, episode=0)
    values, reward = trajectory.action_values, trajectory.reward
    assert values.shape == (len(trajectory), 3)
    assert np.isnan(values[0]).all()
    assert np.array_equal(values[1:].argmax(axis=1), trajectory.action[1:])
    # A decision lasts ten frames; all of its frames tell its values and its reward.
    assert np.isnan(reward[0])
    assert np.array_equal(reward[1:], np.repeat(reward[1::10], 10)[: len(reward) - 1])
    assert trajectory.returns[-1] == pytest.approx(reward[1::10].sum())
    assert len(np.unique(reward[1:])) > 1
    assert record_episode(highway(goal_m=60.0), always(0), seed=0, episode=0).action_values.size == 0


def test_a_part_of_a_recording_keeps_its_numbers():
    trajectory = record_episode(highway(goal_m=60.0), always(0), seed=0, episode=0)
    later = trajectory.since(1.0)
    assert later.time_s[0] == pytest.approx(1.0)
    assert np.array_equal(later.x, trajectory.x[10:])
    assert np.array_equal(later.reward, trajectory.reward[10:])
    assert np.array_equal(later.since(1.5).jerk(), trajectory.jerk()[15:])
    assert later.jerk()[:2].any()
    assert later.outcome == trajectory.outcome
    with pytest.raises(UserError, match="choose a part"):
        trajectory.since(1000.0)
