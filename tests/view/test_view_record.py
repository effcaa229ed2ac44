"""A recorded episode is the episode that was driven, and written to a file it reads back like
recorded traffic.
"""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import torch
from reference.refusals import user_error
from reference.synthetic import synthetic_scenes
from reference.worlds import step
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv
from view_scenes import straight

import ganlane
from ganlane.data import read_scenes, sort
from ganlane.data.schema import SCHEMA, TRACK_STRIDE
from ganlane.env import HighwayEnv
from ganlane.traffic import ReplayTraffic
from ganlane.view import EpisodeLabel, record_episode, to_tracks, write_tracks


def highway(rows=1, lanes=3):
    return ganlane.make_env("idm_mobil", rows, lanes=lanes, vehicles=5, goal_m=60.0)


def recorded(env, action=0, **options):
    """The ego gives always the same command."""
    always = TensorDictModule(
        lambda step: torch.full_like(step, action), in_keys=["step"], out_keys=["action"]
    )
    return record_episode(env, always, **{"seed": 0, "episode": 0, **options})


def recorded_agent(name, **options):
    """The first episode of an agent that ships."""
    driver = ganlane.load_agent(name)
    env = ganlane.make_env(observation=driver.observation, **options)
    return record_episode(env, driver.policy, seed=0, episode=0)


@pytest.fixture(scope="module")
def short():
    return recorded(highway())


def test_the_recording_has_a_frame_per_physics_step():
    env = highway()
    trajectory = recorded(env, seed=4, episode=7, agent="keep_lane", traffic="idm_mobil")
    state = env.reset(env.reset().update({"seed": torch.tensor([4]), "episode": torch.tensor([7])}))
    assert trajectory.x[0] == pytest.approx(state["vehicles", "x"][0].numpy())
    while not state["done"].any():
        state = step(env, state)
    assert trajectory.x[-1] == pytest.approx(state["vehicles", "x"][0].numpy())
    assert len(trajectory) == int(state["step"]) + 1
    assert trajectory.time_s[-1] == pytest.approx(0.1 * int(state["step"]))
    assert trajectory.x[-1, 0] >= 60.0 > trajectory.x[-2, 0]
    assert trajectory.outcome == "goal"
    assert trajectory.action.tolist() == [-1] + [0] * (len(trajectory) - 1)
    label = trajectory.label
    assert (label.agent, label.lanes, label.lane_width_m) == ("keep_lane", 3, 4.0)


def test_the_label_has_the_road_of_the_replayed_scene():
    """Three scenes of 2, 3 and 4 lanes: the environment's own road has the lanes of the widest."""
    scenes = []
    for lanes in (2, 3, 4):
        scene = synthetic_scenes(scenes=1, lanes=lanes, seconds=7.0)
        scenes.append(scene.with_columns(scene=pl.lit(str(lanes))))
    traffic = ReplayTraffic(recordings=sort(pl.concat(scenes)), least_s=5.0)
    env = HighwayEnv(traffic, 1, vehicles=5)
    for episode, name in enumerate(traffic.scenes_of_episodes(0, range(10))):
        assert recorded(env, episode=episode, max_time_s=1.0).label.lanes == int(name)


def test_a_command_off_the_road_ends_the_recording_at_once():
    trajectory = recorded(highway(lanes=1), action=1)
    assert trajectory.outcome == "out_of_road"
    assert len(trajectory) == 1


def test_the_batch_makes_no_difference_and_the_hook_is_taken_out_again(short):
    env = highway(rows=3)
    assert np.array_equal(recorded(env).x, short.x)
    assert env.base_env.recorder is None


def test_an_environment_without_the_hook_cannot_be_recorded():
    with user_error("HighwayEnv"):
        recorded(GymEnv("CartPole-v1"))


def test_a_network_tells_its_values_and_the_rewards_add_up(short):
    """A policy of a Q-network leaves what it expected at each decision; others leave nothing."""
    trajectory = recorded_agent("agent_idm", goal_m=60.0)
    values, reward = trajectory.action_values, trajectory.reward
    assert values.shape == (len(trajectory), 3)
    assert np.isnan(values[0]).all()
    assert np.array_equal(values[1:].argmax(axis=1), trajectory.action[1:])
    # A decision lasts ten frames; all of its frames tell its values and its reward.
    assert np.isnan(reward[0])
    assert np.array_equal(reward[1:], np.repeat(reward[1::10], 10)[: len(reward) - 1])
    assert trajectory.returns[-1] == pytest.approx(reward[1::10].sum())
    assert len(np.unique(reward[1:])) > 1
    assert np.isnan(short.action_values).all()


def test_an_agent_with_the_pedals_is_recorded_too():
    trajectory = recorded_agent("agent_merge", env="merge", actions="continuous", goal_m=100.0)
    assert (trajectory.action == -1).all()
    assert trajectory.x[-1, 0] >= 100.0


# Tracks


def test_parquet_comes_back_exactly(tmp_path):
    env = highway()
    episodes = [recorded(env, episode=number, agent="keep_lane") for number in (0, 1)]
    read = read_scenes(write_tracks(episodes, tmp_path / "simulated.parquet"))
    assert read.schema == SCHEMA
    for number, episode in enumerate(episodes):
        name = f"keep_lane_traffic_0_{number}"
        scene = read.filter(scene=name)
        assert scene.equals(to_tracks(episode, name))
        one = scene.filter(vehicle=3)
        assert one["x"].to_numpy() == pytest.approx(episode.x[:, 3])
        assert one["speed"].to_numpy() == pytest.approx(episode.speed[:, 3])


def test_episodes_that_would_share_a_name_are_numbered(tmp_path):
    label = EpisodeLabel("a/agent.safetensors", "idm", 0, 3)
    labels = [label, replace(label, agent="b/agent.safetensors"), replace(label, agent="mobil")]
    scenes = [straight([0], [0], label=label) for label in labels]
    read = read_scenes(write_tracks(scenes, tmp_path / "a.parquet"))
    names = {"agent_idm_0_3", "agent_idm_0_3-2", "mobil_idm_0_3"}
    assert set(read["scene"]) == names


def test_a_recycled_vehicle_begins_a_new_track_and_padding_is_left_out():
    trajectory = straight([0, 30, 60], [0, 1, 2], frames=12)
    trajectory.x[5:, 1] += 300.0
    trajectory.valid[:, 2] = False
    tracks = to_tracks(trajectory)
    assert set(tracks["vehicle"]) == {0, 1, 1 + TRACK_STRIDE}
    assert tracks.filter(tracks["vehicle"] == 1).height == 5
